"""The root of a zarr store: it says how the store is packed, and whether it is finished. Exactly one of several processes creates it."""

from __future__ import annotations

from typing import Any

from carlasc.errors import ArgumentError, ConflictError, StorageError
from carlasc.storage.files import parse_json, rename, replaced, to_json
from carlasc.storage.packed.output import remove
from carlasc.storage.packed.stores import STORE, VERSION, PackOptions
from carlasc.storage.transport.targets import LocalTarget, Target
from carlasc.storage.zarr.shards import METADATA, group_metadata

_TRIES = 5  # other processes may begin, finish and replace the same store meanwhile
_OPTIONS = ("block", "lossy_mm", "small")


class StoreRoot:
    """The root of a store that is written to, shared by its writers. A new one is created with the first thing that is written.

    Attributes:
        is_finished: whether a finished store with the same options exists, to which more is added.
    """

    def __init__(self, target: Target, options: PackOptions, overwrite: bool) -> None:
        """Check that the store may be written. Nothing is written yet, but a store that is replaced is moved away.

        Raises:
            ArgumentError: the target has no name.
            ConflictError: something else exists there, or a store with other options.
        """
        if isinstance(target, LocalTarget) and not target.folder.name:
            raise ArgumentError("out", expected="the name of a store", found=f"{target.location!r}")
        self._target, self._options, self._overwrite, self._begun = target, options, overwrite, False
        root = read_root(target)
        if root is None:
            _refuse_other(target)
        elif not self._joins(root):
            self.begin()  # what is replaced must not be taken for what was written
            root = None
        self.is_finished = root is not None and root.get("complete") is True

    def begin(self) -> None:
        """Create the root unless it exists: exactly one of several processes does, and the others join it.

        Raises:
            ConflictError: something else exists there, or a store with other options.
        """
        if self._begun:
            return
        for _ in range(_TRIES):
            root = read_root(self._target)
            if root is None:
                _refuse_other(self._target)
                self._begun = self._target.put(METADATA, to_json(group_metadata(self._wanted)), create=True)
            elif self._joins(root):
                self._begun = True
            else:
                _move_away(self._target, finished=root.get("complete") is True)
            if self._begun:
                return
        raise ConflictError(self._target.location, problem="other processes keep replacing it", advice="wait for them")

    @property
    def _wanted(self) -> dict[str, Any]:
        """The attributes of the root of a store that is begun."""
        return {"type": STORE, "version": VERSION, "complete": False, **options_of(self._options)}

    def _joins(self, root: dict[str, Any]) -> bool:
        """Whether a store that exists is written to; if not, it is replaced.

        Raises:
            ConflictError: neither may be done.
        """
        wanted = self._wanted
        differs = [name for name in ("type", "version", *_OPTIONS) if root.get(name) != wanted[name]]
        if not differs:
            return not (self._overwrite and root.get("complete") is True)
        if root.get("type") not in (STORE, "carlasc.unfinished"):
            raise ConflictError(
                self._target.location, expected="a packed store to overwrite", found="another zarr store",
                advice="choose another name",
            )  # fmt: skip
        if not self._overwrite:
            raise ConflictError(
                self._target.location,
                expected="nothing there, or a store with the same options",
                found=f"one with {', '.join(f'{name} {root.get(name)}' for name in differs if name != 'type')}",
                advice="choose another name, remove it, or give `overwrite=True` where there is such an option",
            )
        return False

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_overwrite": False}  # only the process that was told to replaces a store


def options_of(options: PackOptions) -> dict[str, Any]:
    """Return the options of a store as its root records them."""
    return {name: getattr(options, name) for name in _OPTIONS}


def existing_options(target: Target) -> PackOptions | None:
    """Return how a store of this version is packed; None if there is none."""
    root = read_root(target)
    if root is None or root.get("type") != STORE or root.get("version") != VERSION:
        return None
    return PackOptions(**{name: root.get(name, getattr(PackOptions, name)) for name in _OPTIONS})


def read_root(target: Target) -> dict[str, Any] | None:
    """Return the attributes of a zarr store's root, None if there is none."""
    if (data := target.read(METADATA)) is None:
        return None
    found = parse_json(data, target.tree.where(METADATA)).get("attributes")
    return found if isinstance(found, dict) else {}


def remove_replaced(target: Target) -> None:
    """Remove the older store that a finished one replaces, if there is one: also one that was moved away by a run that ended right after that."""
    if isinstance(target, LocalTarget):
        remove(replaced(target.folder))


def _refuse_other(target: Target) -> None:
    """Refuse a place where something is that is no zarr store."""
    if isinstance(target, LocalTarget) and target.folder.exists() and not target.folder.is_dir():
        found: str | None = "a file"
    else:
        found = next(iter(target.paths()), None)
    if found is not None and read_root(target) is None:
        raise ConflictError(
            target.location, expected="nothing there, or a packed store", found=found, advice="choose another name"
        )


def _move_away(target: Target, *, finished: bool) -> None:
    """Move a finished local store away until the new one is finished; remove any other one, root first."""
    if not (isinstance(target, LocalTarget) and finished):
        target.remove(METADATA)
        target.remove("")
        return
    old = replaced(target.folder)
    try:
        remove(old)
        rename(target.folder, old)
    except OSError as error:
        raise StorageError(target.location, problem=f"cannot be replaced: {error.strerror or error}") from error
