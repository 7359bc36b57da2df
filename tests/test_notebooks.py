"""Every notebook runs without the names and settings of others, and is stored without output."""

from pathlib import Path

import nbformat
import pytest

nbclient = pytest.importorskip("nbclient")

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def test_notebooks_are_numbered_without_a_gap_and_have_titles() -> None:
    """A glob that finds nothing would leave the tests below without work."""
    assert [path.name.split("_")[0] for path in NOTEBOOKS] == ["1", "2", "3", "4"]
    for path in NOTEBOOKS:
        first = nbformat.read(path, as_version=4).cells[0]
        assert first.cell_type == "markdown"
        assert first.source.startswith("# "), path.name


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_output_is_stored(path: Path) -> None:
    for cell in nbformat.read(path, as_version=4).cells:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


# before every notebook: no names and no settings of the one before; collector and programs as in conftest.py
CLEAN = """
%reset -f
import gc, os, jax, reframe_jax
jax.config.update("jax_enable_x64", False)
reframe_jax.cache_programs(os.environ["JAX_COMPILATION_CACHE_DIR"])
gc.freeze()
gc.set_threshold(100_000, 50, 1000)
del gc, os, jax, reframe_jax
"""


# The tests run the cells with fewer motions than the reader does: no figure is tested, and calls, loops and
# pictures stay the same. Other tests also compile programs for eight demonstrations.
SMALLER = {
    "np.logspace(-6, -3, 7), 75": "np.logspace(-6, -3, 7), 5",
    "maxiter=100": "maxiter=1",
    "[0, 3, 6], np.empty((4, 3))": "[0, 6], np.empty((4, 2))",
    "part_size=512": "part_size=64",
    "BATCH = 32": "BATCH = 8",
    "joint_positions[0, ::2]": "joint_positions[0, ::10]",
    'for label in "ABI"': 'for label in "AI"',
}


def read_smaller() -> dict[Path, list[nbformat.NotebookNode]]:
    """Cells of every notebook, each phrase of ``SMALLER`` replaced once."""
    cells = {path: nbformat.read(path, as_version=4).cells for path in NOTEBOOKS}
    every = [cell for each in cells.values() for cell in each if cell.cell_type == "code"]
    for phrase, smaller in SMALLER.items():
        (cell,) = (cell for cell in every if phrase in cell.source)
        cell.source = cell.source.replace(phrase, smaller)
    return cells


@pytest.fixture(scope="module")
def executed() -> dict[Path, list[nbformat.NotebookNode]]:
    """Cells of every notebook with their outputs. One kernel runs them all, and traces identify once."""
    cells = read_smaller()
    chain = nbformat.v4.new_notebook()
    for each in cells.values():
        chain.cells += [nbformat.v4.new_code_cell(CLEAN), *each]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(ROOT))
        nbclient.NotebookClient(
            chain,
            timeout=600,
            allow_errors=True,
            kernel_name="python3",
            resources={"metadata": {"path": str(ROOT)}},
        ).execute()
    for cell in chain.cells:
        if cell.source == CLEAN:
            assert not cell.outputs, cell.outputs
    return cells


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("default")
def test_notebooks_run(path: Path, executed: dict[Path, list[nbformat.NotebookNode]], tmp_path: Path) -> None:
    outputs = [output for cell in executed[path] for output in cell.get("outputs", [])]
    for output in outputs:
        assert output.output_type != "error", "\n".join(output.traceback)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    done = nbformat.v4.new_notebook(cells=executed[path])
    nbformat.write(done, tmp_path / path.name)
