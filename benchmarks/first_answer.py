"""How long the first answer takes, by NumPy and by compiled programs, and every answer after it.

A process of its own each time: it imports the library, identifies one recording, and then the same again and
again. NumPy compiles nothing but the random numbers of the search. Compiled programs are timed with nothing
cached, and with their programs in JAX's compilation cache. The table has the seconds of the first answer,
import included, the median of those that follow, the calls after which compiling would have been faster, and
how far the reported origins are apart.
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
AGAIN = 30  # answers after the first

_PROCESS = """
import json, sys, time
start = time.perf_counter()
import numpy as np
import reframe_jax as rf
recording = rf.load_recording(sys.argv[1])
compiled, again, seconds = sys.argv[2] == "compiled", int(sys.argv[3]), []
for _ in range(1 + again):
    found = rf.identify(recording.poses, times=recording.times, compiled=compiled)
    origin = np.asarray(found.linear.position)
    seconds.append(time.perf_counter() - start)
    start = time.perf_counter()
print(json.dumps({"seconds": seconds, "name": found.name, "origin": origin.tolist()}))
"""


def measure(how: str, cache: str | None, recording: Path = RECORDING, again: int = AGAIN) -> dict[str, Any]:
    """Answers of one process: their ``seconds``, the ``name`` and the ``origin``.

    Args:
        how: "compiled" or "numpy".
        cache: folder of JAX's compilation cache; None for none.
        recording: file to identify.
        again: number of answers after the first.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    if cache is not None:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
    command = [sys.executable, "-c", _PROCESS, str(recording), how, str(again)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = new_parser("first_answer", __doc__)
    add = parser.add_argument
    add("--recording", type=Path, default=RECORDING, help="file to identify (the one in examples/)")
    add("--again", type=int, default=AGAIN, help="answers after the first")
    add("--json", type=Path, help="file to write all figures to")
    options = parser.parse_args(argv)
    print(machine())
    print(f"{'':26}{'first, s':>10}{'then, ms':>10}")
    with tempfile.TemporaryDirectory() as cache:
        contestants = {
            "NumPy": ("numpy", None),
            "compiled, nothing cached": ("compiled", cache),
            "compiled, from the cache": ("compiled", cache),
        }
        rows = {}
        for name, (how, where) in contestants.items():
            answer = measure(how, where, options.recording, options.again)
            first, then = answer["seconds"][0], float(np.median(answer["seconds"][1:]))
            rows[name] = {**answer, "first": first, "then": then}
            print(f"{name:26}{first:>10.1f}{1e3 * then:>10.1f}", flush=True)
    numpy = rows["NumPy"]
    for name, row in list(rows.items())[1:]:
        calls = (row["first"] - numpy["first"]) / (numpy["then"] - row["then"])
        print(f"{name} is faster from call {calls:.0f} on")
        rows[name]["faster from"] = calls
    apart = [np.subtract(row["origin"], numpy["origin"]) for row in rows.values()]
    names = {row["name"] for row in rows.values()}
    print(f"{' / '.join(sorted(names))}; origins at most {np.abs(apart).max():.1g} m apart")
    write_record(options.json, {"machine": machine(), "rows": rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
