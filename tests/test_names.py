"""Names in the code are terms of the field, and sentences say what is meant, without riddles."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
FOLDERS = ("reframe_jax", "benchmarks", "tests", "docs", "examples")

# a word that no name contains, and what to write instead
WORDS = {
    "alone": "single, unique, or the operation: axis_projected",
    "blaming": "attribute_to",
    "far": "distant, or what is compared with which limit",
    "follow": "advance, stop_gradient_unless, compute_evidence",
    "idle": "residual_rotation_rms",
    "once": "materialize, timed_call",
    "say": "print_error, print_progress",
    "settled": "Classification, converged, tolerance",
    "share": "fraction, ratio, divisor",
    "show": "print_result, draw, move_to",
    "stillest": "least_motion",
    "stumbling": "translate_errors",
    "sure": "covariance, confident, probability",
    "those": "the noun, such as candidate_frames",
    "told": "determination, on_screw_axis",
    "unsteady": "detrended_variance",
}
# whole names that are not allowed, and what to write instead
NAMES = {
    "n": "the quantity that is counted",
    "_motion": "prepare_motion, motion_scale",
    "_have_met": "chains_agree",
    "_written_out": "unrolled",
    "_Either": "no such proxy",
    "_NOT_LESS": "what is bounded",
    "independent_after": "decorrelation_length",
}


# phrases that no docstring, message or page contains, and what to write instead
PHRASES = {
    "what is said of": "the result of",
    "of the only window": "a batch of one window",
    "explains the motion as well": "fits equally well (tied)",
    "of the axis is as right": "any point on this axis is equally valid",
    "all others together": "the name is uncertain, with its probability",
    "errors may be larger than that": "the true error may exceed this interval",
    "only this one path was tried": "the motion covered a single path",
    "where there are no more": "repeat the last row past the end",
    "leave for the search": "the statistics that the search needs",
}


def defined_names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of everything that a module defines; names of other libraries do not count."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id if isinstance(node, ast.Name) else node.attr
        elif isinstance(node, ast.alias) and node.asname:
            yield node.lineno, node.asname
        elif isinstance(node, ast.ExceptHandler | ast.MatchAs | ast.MatchStar) and node.name:
            yield node.lineno, node.name


def unclear_words(name: str) -> set[str]:
    """Words of a name that the lists above do not allow."""
    if name.startswith("test_"):  # a sentence
        return set()
    parts = set(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().split("_"))
    return (parts & set(WORDS)) | ({name} & set(NAMES))


def source_files() -> Iterator[tuple[str, str]]:
    """Path and Python code of every module and notebook."""
    for file in sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        yield file.relative_to(ROOT).as_posix(), file.read_text()
    for file in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(file.read_text())["cells"]
        code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
        lines = [line for cell in code for line in cell.splitlines() if not line.startswith("%")]
        yield file.relative_to(ROOT).as_posix(), "\n".join(lines)


def test_no_name_is_an_everyday_word() -> None:
    wrong = []
    for place, code in source_files():
        names = [(1, Path(place).stem), *defined_names(ast.parse(code))]
        for line, name in names:
            for word in unclear_words(name):
                wrong.append(f"{place}:{line}: {name}: instead of {word!r}: {(WORDS | NAMES)[word]}")
    assert not wrong, "\n".join(wrong)


def test_no_sentence_is_a_riddle() -> None:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
    texts = [(page.name, page.read_text()) for page in pages]
    texts += [text for text in source_files() if text[0] != "tests/test_names.py"]
    assert [line for place, text in texts for line in riddles(place, text)] == []


def riddles(place: str, text: str) -> list[str]:
    """Places of the phrases that the list above does not allow."""
    words = " ".join(text.lower().split())
    return [f"{place}: {phrase!r}: {plain}" for phrase, plain in PHRASES.items() if phrase in words]


def test_the_check_sees_words_within_names() -> None:
    assert unclear_words("_LinkShare") == {"share"}
    assert unclear_words("_FAR_ORIGIN") == {"far"}
    assert unclear_words("n") == {"n"}
    assert riddles("page", "What is said\nof every window") == ["page: 'what is said of': the result of"]
    assert not riddles("page", "The result of every window")
    code = "try:\n  pass\nexcept OSError as once:\n  pass\nasync def told(): pass\n"
    assert sorted(name for _, name in defined_names(ast.parse(code))) == ["once", "told"]
    for right in ("fraction", "number", "shares_memory", "showwarning", "test_what_is_told"):
        assert not unclear_words(right)
