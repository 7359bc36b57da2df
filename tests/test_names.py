"""Names in the code are terms of the field: everyday words that need a guess are not allowed as names."""

import ast
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


def defined_names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of everything that a module defines; names of other libraries do not count."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id if isinstance(node, ast.Name) else node.attr
        elif isinstance(node, ast.alias) and node.asname:
            yield node.lineno, node.asname


def unclear_words(name: str) -> set[str]:
    """Words of a name that the lists above do not allow."""
    if name.startswith("test_"):  # a sentence
        return set()
    parts = set(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().split("_"))
    return (parts & set(WORDS)) | ({name} & set(NAMES))


def test_no_name_is_an_everyday_word() -> None:
    wrong = []
    for file in sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        place = file.relative_to(ROOT).as_posix()
        for line, name in defined_names(ast.parse(file.read_text())):
            for word in unclear_words(name):
                wrong.append(f"{place}:{line}: {name}: instead of {word!r}: {(WORDS | NAMES)[word]}")
    assert not wrong, "\n".join(wrong)


def test_the_check_sees_words_within_names() -> None:
    assert unclear_words("_LinkShare") == {"share"}
    assert unclear_words("_FAR_ORIGIN") == {"far"}
    assert unclear_words("n") == {"n"}
    for right in ("fraction", "number", "shares_memory", "showwarning", "test_what_is_told"):
        assert not unclear_words(right)
