"""Files of ROS 2, `.db3`: a SQLite database with a table of topics and one of messages."""

from __future__ import annotations

import sqlite3
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from carlasc.errors import FormatError
from carlasc_converters.bag_messages import Channel, FileIndex

MAGIC = b"SQLite format 3\0"
_EXPECTED = "a bag of ROS 2: a database with topics and messages"


def index_file(path: Path) -> FileIndex:
    """Return the index of the messages of a file; of a file that is cut short, those that SQLite
    can still read.
    """
    index = FileIndex(str(path))
    rows = array("q")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(32)
    page = int.from_bytes(head[16:18], "big")
    whole = (65536 if page == 1 else page) * int.from_bytes(head[28:32], "big")
    with _database(str(path)) as database:
        topics = database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ).fetchall()
        index.channels = {
            number: Channel(name, kind, encoding) for number, name, kind, encoding in topics
        }
        try:
            for row in database.execute("SELECT topic_id, timestamp, id FROM messages ORDER BY id"):
                rows.extend(row)
        except sqlite3.DatabaseError as error:
            index.lost = f"SQLite gives only {len(rows) // 3} messages of it ({error})"
        table = np.array(rows, np.int64).reshape(-1, 3)
        if size < whole:
            table = table[[_is_whole(database, number) for number in table[:, 2].tolist()]]
            index.lost = f"it has {size} of {whole} bytes, and {len(table)} messages are whole"
    for number in np.unique(table[:, 0]).tolist():
        own = table[table[:, 0] == number]
        index.add(number, -1, own[:, 1], own[:, 2])
    return index


def read_message(path: str, chunk: int, offset: int) -> bytes:
    """Return the content of a message, whose number is `offset`.

    Raises:
        FormatError: the file does not contain it.
    """
    with _database(path) as database:
        row = database.execute("SELECT data FROM messages WHERE id = ?", (offset,)).fetchone()
    if row is None:
        raise FormatError(path, expected=f"message {offset}", found="none")
    return bytes(row[0])


def _is_whole(database: sqlite3.Connection, number: int) -> bool:
    """Return whether the content of a message can be read."""
    try:
        database.execute("SELECT data FROM messages WHERE id = ?", (number,)).fetchone()
    except sqlite3.DatabaseError:
        return False
    return True


@contextmanager
def _database(path: str) -> Iterator[sqlite3.Connection]:
    """Open a database for reading only."""
    mode = "mode=ro" if Path(f"{path}-wal").exists() else "immutable=1"
    try:
        database = sqlite3.connect(f"{Path(path).resolve().as_uri()}?{mode}", uri=True)
        try:
            # otherwise, SQLite does not open files that are cut short
            database.execute("PRAGMA writable_schema = ON")
            yield database
        finally:
            database.close()
    except sqlite3.Error as error:
        raise FormatError(
            path, expected=_EXPECTED, found=f"another file, or a damaged one ({error})"
        ) from error
