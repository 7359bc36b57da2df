"""The documentation runs, covers every public name, and promises nothing that is not there."""

import importlib.util
import inspect
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from exported import names_of

import reframe_jax
from reframe_jax.constraints.catalogue import CONSTRAINTS, OTHER_CONSTRAINTS, Constraint

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


@pytest.fixture
def plain_jax() -> Iterator[None]:
    """JAX's own settings, as a reader has them."""
    names = ("jax_enable_x64", "jax_numpy_dtype_promotion", "jax_numpy_rank_promotion")
    before = {name: getattr(jax.config, name) for name in names}
    for name, value in zip(names, (False, "standard", "allow"), strict=True):
        jax.config.update(name, value)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


sys.path.insert(0, str(DOCS))
import cells  # noqa: E402

PAGES = (
    "README.md",
    "docs/tutorial.md",
    "docs/gallery.md",
    "docs/simulation.md",
    "docs/large.md",
    "docs/exports.md",
    "docs/uncertainty.md",
    "docs/sequences.md",
)


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.filterwarnings("default")
def test_cells_print_what_the_page_shows(page: str, plain_jax: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a change of the outputs: ``python docs/cells.py PAGE``, and read the difference."""
    monkeypatch.chdir(ROOT)
    _, outputs = cells.run_cells((ROOT / page).read_text(), page)
    assert outputs
    differences = [line for stored, new in outputs for line in cells.output_differences(stored, new)]
    assert not differences, "\n".join(differences)


def test_every_cell_of_the_tutorial_shows_its_output() -> None:
    text = (DOCS / "tutorial.md").read_text()
    outputs = cells.stored_outputs(text)
    assert len(outputs) == text.count("```python") > 10
    assert all(outputs)


@pytest.mark.parametrize(
    "entry", [*CONSTRAINTS.values(), *OTHER_CONSTRAINTS.values()], ids=lambda row: row.label
)
def test_the_gallery_shows_every_named_constraint(entry: Constraint) -> None:
    heading = f"{entry.label}: {entry.name}" if entry.label in CONSTRAINTS else entry.name
    (section,) = re.findall(
        rf"^## {heading}\n(.*?)(?=^## |\Z)", (DOCS / "gallery.md").read_text(), re.M | re.S
    )
    assert f"(images/gallery_{entry.label}.png)" in section
    for word in ("- Example: ", "- Try it: ", f'simulate("{entry.label}"'):
        assert word in section
    (freedom,) = re.findall(r"^- Degrees of freedom: (.*)$", section, re.MULTILINE)
    turns, slides = sum(entry.angular_dof), sum(entry.linear_dof)
    together = turns if entry.label == "screw" else turns + slides
    assert freedom.startswith(f"{together} (")
    if entry.label not in ("screw", "universal"):
        words = [
            f"{count} {noun}{'s' * (count != 1)}"
            for count, noun in ((turns, "rotation"), (slides, "translation"))
        ]
        assert freedom.startswith(f"{together} ({', '.join(words)})")
    assert ("; type" in freedom) == (entry.linear_type is not None)
    assert entry.linear_type is None or freedom.endswith(f"; type {entry.linear_type.name}.")


def test_the_first_paragraph_names_the_readers() -> None:
    """Every page says what it is for, and who reads it or when."""
    for page in sorted(DOCS.glob("*.md")):
        if page.name in ("changelog.md", "contributing.md"):  # these include a file
            continue
        title, paragraph = page.read_text().split("\n\n")[:2]
        assert title.startswith("# "), page.name
        assert re.match(r"This (page|site) ", paragraph), page.name
        assert re.search(
            r"\b(Read|Search|Most readers|for (people|readers|developers|programs))\b", paragraph
        ), page.name
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_outputs_agree_to_the_printed_digits() -> None:
    for stored, printed in (
        ("tip 0.0999 m", "tip  0.1001 m"),
        ("-0.001", "0.000"),
        ("1.0e-04 m", "1.04e-04 m"),
    ):
        assert not cells.output_differences(stored, printed)
    for stored, printed in (("tip 0.0999 m", "tip 0.1099 m"), ("A 1", "B 1"), ("A", "A\nB"), ("6", "9")):
        assert cells.output_differences(stored, printed)


def test_key_figures_are_those_of_the_stored_benchmark() -> None:
    summary = json.loads((ROOT / "benchmarks" / "results" / "golden.json").read_text())["summary"]
    readme = (ROOT / "README.md").read_text()
    confident = [f"{summary[group]['sure']} in `{group}`" for group in ("real", "white")]
    assert f"Names with a probability ≥ 0.9: {', '.join(confident)}." in readme
    rows = re.findall(r"^\| [^|]+\(`(\w+)`\) \|(.+)\|$", readme, re.MULTILINE)
    assert len(rows) == 9
    for group, cells_of_row in rows:
        row = summary[group]
        errors = ["–" if row[key] is None else f"{row[key]:g}" for key in ("position_mm", "axis_deg")]
        expected = [f"{row['right']} of {row['number']}", str(row["wrong_sure"]), *errors]
        assert [cell.strip() for cell in cells_of_row.split("|")] == expected, group


@pytest.mark.filterwarnings("default")
def test_an_objective_of_ones_own_finds_its_minimum(plain_jax: None) -> None:
    names, outputs = cells.run_cells((DOCS / "objectives.md").read_text(), "docs/objectives.md")
    differences = [line for stored, new in outputs for line in cells.output_differences(stored, new)]
    assert not differences, "\n".join(differences)
    found, by_hand = names["found"], names["by_hand"]
    np.testing.assert_allclose(found.x, names["centres"], atol=1e-3)
    np.testing.assert_allclose(np.exp(found.value), 1e-3, rtol=0.2)
    np.testing.assert_array_less(0.25, found.agreement)  # more than one restart
    np.testing.assert_allclose(by_hand.x, names["centres"], atol=1e-3)
    np.testing.assert_allclose(by_hand.value, found.value, atol=1e-3)


def test_every_public_name_is_in_the_reference() -> None:
    text = (DOCS / "api.md").read_text()
    named = set(re.findall(r"^\.\. (?:auto\w+|data):: (\w+)$", text, re.MULTILINE))
    assert named == set(reframe_jax.__all__)


def test_every_public_name_of_the_modules_is_explained() -> None:
    modules = re.findall(r"^\.\. automodule:: (\S+)$", (DOCS / "api-modules.md").read_text(), re.MULTILINE)
    assert {
        f"reframe_jax.{name}"
        for name in ("simulation.synthetic", "simulation.metrics", "plotting", "simulation.arm")
    } <= set(modules)
    for name in ["reframe_jax", *modules]:
        module = importlib.import_module(name)
        for public in names_of(module):
            thing = getattr(module, public)
            if inspect.isclass(thing) or inspect.isfunction(thing):
                assert inspect.getdoc(thing), f"{name}.{public} has no docstring"


def test_formulas_are_drawn_without_a_network() -> None:
    pytest.importorskip("sphinx")
    spec = importlib.util.spec_from_file_location("mathml", DOCS / "mathml.py")
    assert spec is not None
    assert spec.loader is not None
    mathml = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(mathml)
    text = (DOCS / "method.md").read_text()
    formulas = re.findall(r"\$\$(.+?)\$\$|\$(.+?)\$", text, re.DOTALL)
    assert len(formulas) > 40
    for block, inline in formulas:
        assert mathml.formula(block or inline, bool(block)).startswith("<math")
    with pytest.raises(mathml.MathError):  # docutils reads twelve, TeX one half
        mathml.formula(r"\tfrac12 x", False)
    assert "mathjax" not in (DOCS / "conf.py").read_text()


def test_links_between_pages_lead_somewhere() -> None:
    count = 0
    for page in (*DOCS.glob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"):
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
            count += 1
    assert count > 10


def test_commands_and_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    targets, modules = set(), set()
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.glob("*.md")):
        text = page.read_text()
        for target in re.findall(r"(?:^ {4}|`)make ([\w-]+)", text, re.MULTILINE):
            assert f"\n{target}:" in makefile, f"{page.name}: make {target}"
            targets.add(target)
        for module in re.findall(r"python -m (benchmarks\.\w+)", text):
            assert importlib.util.find_spec(module), f"{page.name}: {module}"
            modules.add(module)
    assert {"test", "demo"} <= targets
    assert "benchmarks.identification" in modules
