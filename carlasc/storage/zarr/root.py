"""The root of a zarr store, with its options and whether it is finished.

Exactly one of several processes creates it.
"""

from __future__ import annotations

from typing import Any

from carlasc.errors import ArgumentError, ConflictError, StorageError
from carlasc.storage.files import parse_json, remove, rename, replaced, to_json
from carlasc.storage.packed.stores import STORE, VERSION, PackOptions
from carlasc.storage.transport.trees import LocalTarget, Target
from carlasc.storage.zarr.shards import METADATA, group_metadata

_TRIES = 5  # other processes may create, finish and replace the same store meanwhile
_OPTIONS = ("block", "lossy_mm", "small")


class StoreRoot:
    """The root of a store that is being written, shared by its writers.

    A new root is created before the first write.

    Attributes:
        is_finished: whether a finished store with the same options exists, and frames are added to
            it.
    """

    def __init__(self, target: Target, options: PackOptions, overwrite: bool) -> None:
        """Check that the store may be written.

        Nothing is written yet, but a store to replace is moved away.

        Raises:
            ArgumentError: the target has no name.
            ConflictError: other data, or a store with other options, exist at the target.
        """
        if isinstance(target, LocalTarget) and not target.folder.name:
            raise ArgumentError("out", expected="the name of a store", found=f"{target.location!r}")
        self._target = target
        self._options = options
        self._overwrite = overwrite
        self._begun = False
        root = read_root(target)
        if root is None:
            _refuse_other(target)
        elif not self._joins(root):
            self.begin()  # otherwise the old store could be mistaken for the new one
            root = None
        self.is_finished = root is not None and root.get("complete") is True

    def begin(self) -> None:
        """Create the root unless it exists.

        Exactly one of several processes creates it, and the others use it.

        Raises:
            ConflictError: other data, or a store with other options, exist at the target.
        """
        if self._begun:
            return
        for _ in range(_TRIES):
            root = read_root(self._target)
            if root is None:
                _refuse_other(self._target)
                self._begun = self._target.put(
                    METADATA, to_json(group_metadata(self._wanted)), create=True
                )
            elif self._joins(root):
                self._begun = True
            else:
                _move_away(self._target, finished=root.get("complete") is True)
            if self._begun:
                return
        raise ConflictError(
            self._target.location,
            problem="other processes keep replacing it",
            advice="wait until they have ended",
        )

    @property
    def _wanted(self) -> dict[str, Any]:
        """The attributes of the root of a new store."""
        return {"type": STORE, "version": VERSION, "complete": False, **options_of(self._options)}

    def _joins(self, root: dict[str, Any]) -> bool:
        """Whether to write to an existing store; if not, it is replaced.

        Raises:
            ConflictError: neither is allowed.
        """
        wanted = self._wanted
        differs = [
            name for name in ("type", "version", *_OPTIONS) if root.get(name) != wanted[name]
        ]
        if not differs:
            return not (self._overwrite and root.get("complete") is True)
        if root.get("type") not in (STORE, "carlasc.unfinished"):
            raise ConflictError(
                self._target.location, expected="a packed store to overwrite", found="another zarr "
                                                                                     "store",
                advice="choose another name",
            )  # fmt: skip
        if not self._overwrite:
            raise ConflictError(
                self._target.location,
                expected="a new path, or a store with the same options",
                found=f"one with "
                f"{', '.join(f'{name} {root.get(name)}' for name in differs if name != 'type')}",
                advice="choose another name, remove it, or give `overwrite=True` if the command "
                "has this option",
            )
        return False

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_overwrite": False}  # only the original process replaces a store


def options_of(options: PackOptions) -> dict[str, Any]:
    """Return the options as they are recorded in the root."""
    return {name: getattr(options, name) for name in _OPTIONS}


def existing_options(target: Target) -> PackOptions | None:
    """Return the options of an existing store of this version; None if it does not exist."""
    root = read_root(target)
    if root is None or root.get("type") != STORE or root.get("version") != VERSION:
        return None
    return PackOptions(**{name: root.get(name, getattr(PackOptions, name)) for name in _OPTIONS})


def read_root(target: Target) -> dict[str, Any] | None:
    """Return the attributes of the root of a zarr store; None if it does not exist."""
    if (data := target.read(METADATA)) is None:
        return None
    found = parse_json(data, target.tree.where(METADATA)).get("attributes")
    return found if isinstance(found, dict) else {}


def remove_replaced(target: Target) -> None:
    """Remove the older store that a finished store replaces, if it exists, even if an interrupted
    run has moved it away.
    """
    if isinstance(target, LocalTarget):
        remove(replaced(target.folder))


def _refuse_other(target: Target) -> None:
    """Raise ConflictError if the target exists and is not a zarr store."""
    if isinstance(target, LocalTarget) and target.folder.exists() and not target.folder.is_dir():
        found: str | None = "a file"
    else:
        found = next(iter(target.paths()), None)
    if found is not None and read_root(target) is None:
        raise ConflictError(
            target.location,
            expected="a new path, or a packed store",
            found=found,
            advice="choose another name",
        )


def _move_away(target: Target, *, finished: bool) -> None:
    """Move a finished local store away until the new one is finished.

    Remove any other store, root first.
    """
    if not (isinstance(target, LocalTarget) and finished):
        target.remove(METADATA)
        target.remove("")
        return
    old = replaced(target.folder)
    try:
        remove(old)
        rename(target.folder, old)
    except OSError as error:
        raise StorageError(
            target.location, problem=f"cannot be replaced: {error.strerror or error}"
        ) from error
