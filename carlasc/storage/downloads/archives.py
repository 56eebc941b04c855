"""The published zips as one table (see the format page, `docs/format.md#layout`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from carlasc.errors import ArgumentError

_S3 = "https://curly-dataset-public.s3.us-east-2.amazonaws.com/CARLA"
SEQUENCES = "sequences"


@dataclass(frozen=True)
class Archive:
    """One zip.

    Attributes:
        name: file name.
        what: "sequences" (scans, poses, coarse Cartesian grids), or grids alone: "fine", "cylindrical".
        split: "train", "val", "test"; None if it holds all of them.
        url: its URL.
        gigabytes: its approximate size.
    """

    name: str
    what: str
    split: str | None
    url: str
    gigabytes: float

    @property
    def folder(self) -> str:
        """Folder that it is extracted to, inside the one that the user chose.

        The grids' zips have folders of their own: in them, the grids have the same names as the coarse grids of the sequences.
        """
        return "." if self.what == SEQUENCES else self.name.removesuffix(".zip")


ARCHIVES = (
    Archive("train_cartesian_13.zip", SEQUENCES, "train", f"{_S3}/train_cartesian_13.zip", 40.3),
    Archive("train_cartesian_46.zip", SEQUENCES, "train", f"{_S3}/train_cartesian_46.zip", 39.7),
    Archive("val_cartesian.zip", SEQUENCES, "val", f"{_S3}/val_cartesian.zip", 14.9),
    Archive("test_cartesian.zip", SEQUENCES, "test", f"{_S3}/test_cartesian.zip", 14.6),
    Archive("eval_fine.zip", "fine", None, f"{_S3}/eval_fine.zip", 4.3),
    Archive(
        "eval_cylindrical.zip",
        "cylindrical",
        None,
        "https://www.dropbox.com/s/eb074zjfilri1ka/eval_cylindrical.zip?dl=1",
        3.8,
    ),
)


def choose_archives(splits: Iterable[str], what: str) -> tuple[Archive, ...]:
    """Return the zips of some splits, or of some grids.

    Args:
        splits: "train", "val", "test" or "all", in any case; none for grids, whose zips hold all splits.
        what: "sequences", "fine" or "cylindrical".

    Raises:
        ArgumentError: `splits` or `what` is unknown, or a split is given for grids.
    """
    kinds = tuple(dict.fromkeys(archive.what for archive in ARCHIVES))
    if what not in kinds:
        raise ArgumentError("what", expected=f"one of {', '.join(kinds)}", found=repr(what))
    known = tuple(dict.fromkeys(archive.split for archive in ARCHIVES if archive.split))
    wanted = {split.lower() for split in splits}
    if unknown := wanted - {*known, "all"}:
        raise ArgumentError("split", expected=f"one of {', '.join(known)}, all", found=", ".join(sorted(unknown)))
    if what != SEQUENCES and wanted - {"all"}:
        raise ArgumentError(
            "split",
            expected=f"none with {what} grids",
            found=", ".join(sorted(wanted)),
            advice="leave it out: one zip holds the grids of all splits",
        )
    if what == SEQUENCES and not wanted:
        raise ArgumentError("split", expected=f"one of {', '.join(known)}, all", found="none")
    return tuple(
        archive
        for archive in ARCHIVES
        if archive.what == what and (archive.split is None or archive.split in wanted or "all" in wanted)
    )
