"""Columns of Feather files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from carlasc.core.arrays import AnyArray
from carlasc.errors import FormatError, MissingDataError, import_extra
from carlasc_converters.files import opening


def read_columns(
    path: Path, names: Sequence[str], texts: Sequence[str] = ()
) -> dict[str, AnyArray]:
    """Read columns of a Feather file.

    Args:
        path: the file.
        names: names of columns of numbers.
        texts: names of columns of text.

    Returns:
        (N,) array by name: numbers of the type of the file, and text as Python strings.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it is not a Feather file, lacks a column, or has a column of another type or
            with missing values.
        DependencyError: pyarrow is not installed.
    """
    feather = import_extra("pyarrow.feather", "parquet")
    if not path.is_file():
        raise MissingDataError(
            path, expected="a Feather file", found="nothing", advice="download it again"
        )
    with opening(path, "a Feather file"):
        # frames are already read in parallel
        table = feather.read_table(str(path), use_threads=False)
        table.validate(full=True)
    if lacking := [name for name in (*names, *texts) if name not in table.column_names]:
        found = ", ".join(table.column_names) or "no columns"
        raise FormatError(path, expected=f"the columns {', '.join(lacking)}", found=found)
    columns = {}
    for name in (*names, *texts):
        column = table.column(name)
        kinds, kind = ("O", "text") if name in texts else ("iuf", "numbers")
        with opening(path, f"{kind} in the column {name}"):
            array = column.to_numpy()
        if column.null_count or (array.dtype.kind not in kinds and len(array)):
            found = f"{column.null_count} missing values" if column.null_count else str(column.type)
            raise FormatError(path, expected=f"{kind} in the column {name}", found=found)
        columns[name] = array
    return columns
