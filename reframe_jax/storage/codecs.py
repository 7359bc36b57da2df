"""File formats of a part: named arrays and a line of text, as a NumPy archive or as Parquet."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

_HEADER = "reframe_jax"


class _Npz:
    """One array of the archive per array, and one for the text."""

    suffix = ".npz"

    def write(self, file: Path, arrays: Mapping[str, np.ndarray], header: str) -> None:
        entries: dict[str, Any] = {**arrays, _HEADER: header}
        with file.open("wb") as stream:
            np.savez_compressed(stream, **entries)

    def read(self, stream: BinaryIO) -> tuple[dict[str, Any], str]:
        with np.load(stream) as stored:
            arrays = dict(stored)
        return arrays, str(arrays.pop(_HEADER))


class _Parquet:
    """One column per array: the first axis gives the rows, the other axes give nested lists."""

    suffix = ".parquet"

    def write(self, file: Path, arrays: Mapping[str, np.ndarray], header: str) -> None:
        arrow = self.library()
        table = arrow.table({name: _to_arrow(arrow, np.asarray(array)) for name, array in arrays.items()})
        # dictionary encoding merges numbers that compare equal but differ in their bits, such as 0 and -0
        arrow.parquet.write_table(
            table.replace_schema_metadata({_HEADER: header}), file, use_dictionary=False
        )

    def read(self, stream: BinaryIO) -> tuple[dict[str, Any], str]:
        table = self.library().parquet.read_table(stream)
        header = table.schema.metadata[_HEADER.encode()].decode()
        return {name: _from_arrow(table.column(name)) for name in table.column_names}, header

    @staticmethod
    def library() -> Any:
        """Import PyArrow, or raise an ImportError that names the extra."""
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError as error:
            raise ImportError(
                "Results are stored as Parquet, which needs pyarrow: pip install 'reframe-jax[parquet]'"
            ) from error
        return pyarrow


NPZ = _Npz()
PARQUET = _Parquet()
Codec = _Npz | _Parquet
"""A file format of parts; reading raises the errors of the format for a damaged file."""


def _to_arrow(arrow: Any, values: np.ndarray) -> Any:
    """Convert an array (N, a, b, ...) to a column of N nested lists of fixed size."""
    column = arrow.array(np.ascontiguousarray(values).reshape(-1))
    for size in reversed(values.shape[1:]):
        column = arrow.FixedSizeListArray.from_arrays(column, size)
    return column


def _from_arrow(column: Any) -> np.ndarray:
    """Convert a column of :func:`_to_arrow` back to an array."""
    values, shape = column.combine_chunks(), [len(column)]
    while hasattr(values.type, "list_size"):
        shape.append(values.type.list_size)
        values = values.flatten()
    return np.asarray(values.to_numpy(zero_copy_only=False)).reshape(shape)
