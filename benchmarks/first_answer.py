"""Measure the time of the first call in a process, by stage, and of later calls.

Each measurement starts a new process that imports the library, identifies one recording, and then repeats the
same call. The stages of the first call are: import, tracing (Python builds the programs), compilation (XLA
compiles the programs, or reads them from JAX's compilation cache), and execution. Programs are compiled while
others are traced: compilation is the time that remains after tracing. Execution takes as long as in later
calls. The benchmark runs with an empty cache, and with the programs of an earlier process in the cache.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import machine, new_parser, write_record

__all__ = ["measure"]

RECORDING = Path(__file__).parent.parent / "examples" / "pin_on_plane.csv"
AGAIN = 30  # calls after the first
STAGES = "import", "trace", "compile", "run"

_PROCESS = """
import json, sys, time
start = time.perf_counter()
import jax
import numpy as np
import reframe_jax as rf
rf.identify
if sys.argv[3]:
    rf.cache_programs(sys.argv[3])
stages = {"import": time.perf_counter() - start, "trace": 0.0}
TRACE = "/jax/core/compile/jaxpr_trace_duration", "/jax/core/compile/jaxpr_to_mlir_module_duration"
def listen(event, seconds, **_):
    if event in TRACE:
        stages["trace"] += seconds
jax.monitoring.register_event_duration_secs_listener(listen)
recording = rf.load_recording(sys.argv[1])
answers = []
for _ in range(1 + int(sys.argv[2])):
    start = time.perf_counter()
    found = rf.identify(recording.poses, times=recording.times)
    np.asarray(found.linear.position)
    answers.append(time.perf_counter() - start)
stages["run"] = float(np.median(answers[1:]))
stages["compile"] = answers[0] - stages["trace"] - stages["run"]
print(json.dumps({"stages": stages, "then": answers[1:], "name": found.name}))
"""


def measure(cache: str | None, recording: Path = RECORDING, again: int = AGAIN) -> dict[str, Any]:
    """Run one process: ``stages`` of the first call in s, ``then`` later calls in s, and the ``name``.

    Args:
        cache: folder for :func:`reframe_jax.cache_programs`; None for no cache.
        recording: file to identify.
        again: number of calls after the first, one or more.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    command = [sys.executable, "-c", _PROCESS, str(recording), str(again), cache or ""]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = new_parser("first_answer", __doc__)
    add = parser.add_argument
    add("--recording", type=Path, default=RECORDING, help="file to identify (the one in examples/)")
    add("--again", type=int, default=AGAIN, help="number of later calls, one or more")
    add("--json", type=Path, help="file to write all figures to")
    options = parser.parse_args(argv)
    print(machine())
    print(f"{'seconds':16}{''.join(f'{stage:>9}' for stage in STAGES)}{'all':>9}{'then, ms':>10}")
    rows = {}
    with tempfile.TemporaryDirectory() as cache:
        for name in ("nothing cached", "from the cache"):
            rows[name] = measure(cache, options.recording, options.again)
            stages = [rows[name]["stages"][stage] for stage in STAGES]
            then = 1e3 * float(np.median(rows[name]["then"]))
            print(
                f"{name:16}{''.join(f'{s:>9.2f}' for s in (*stages, sum(stages)))}{then:>10.1f}", flush=True
            )
    write_record(options.json, {"machine": machine(), "rows": rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
