"""The client of S3, Google Cloud Storage and Azure, through obstore.

obstore signs, sends and checks requests; this module translates options and errors. Its own retries
are turned off, so that one rule holds for every server (`requests`).
"""

from __future__ import annotations

import importlib
import os
import sys
import threading
from collections.abc import Iterable, Mapping
from datetime import timedelta
from importlib.machinery import ExtensionFileLoader, ModuleSpec
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from carlasc.errors import ArgumentError, CarlascError, import_extra, without_credentials
from carlasc.storage.transport.clients import Client
from carlasc.storage.transport.failures import (
    WrongAnswerError,
    status_and_code,
)

SCHEMES = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "adl")
"""Schemes of object stores."""

PRIVATE = "obstore._obstore"
"""The compiled module of obstore, an undocumented name."""

_S3 = ("s3", "s3a")
_MARK = "carlasc-writer"
_PART_BYTES = 100 << 20  # larger objects are sent in parts of this size
# An upload has no other limit than this multiple of the time without data from the server: the
# server is silent while it receives.
_UPLOAD_TIMES = 10
# names of options of fsspec's file systems -> names of obstore
_S3_NAMES = {
    "key": "access_key_id",
    "secret": "secret_access_key",
    "token": "session_token",
    "endpoint_url": "endpoint",
    "region_name": "region",
    "anon": "skip_signature",
}
_GOOGLE_NAMES = {"token": "service_account", "anon": "skip_signature"}
_NAMES = {"s3": _S3_NAMES, "s3a": _S3_NAMES, "gs": _GOOGLE_NAMES, "gcs": _GOOGLE_NAMES}


class ObjectStoreClient(Client):
    """The client of a bucket."""

    exclusive = True

    def __init__(self, url: str, options: Mapping[str, Any]) -> None:
        super().__init__(url, options)
        import_extra("obstore", "remote")
        self._root = "/".join(url.split("/", 3)[:3])

    def open(self) -> tuple[Any, Any]:
        """Return two stores of the bucket, to read and to write: they have other time limits."""
        given = {**self.options, **self.options.get("client_kwargs", {})}
        given.pop("client_kwargs", None)
        names = _NAMES.get(self.scheme, {"anon": "skip_signature"})
        config = {names.get(name, name): value for name, value in given.items()}
        if config.get("service_account") == "anon":
            config = {"skip_signature": True}
        provider = self._provider(config) if self.scheme in _S3 else None
        address = str(config.get("endpoint", ""))
        silence = timedelta(seconds=self.settings.timeout_s)
        limits = (
            {"read_timeout": silence, "timeout": timedelta(days=1)},
            {"timeout": silence * _UPLOAD_TIMES},
        )
        scheme = {"s3a": "s3", "gcs": "gs"}.get(self.scheme, self.scheme)
        library = _library()
        try:
            reading, writing = (
                library.store.from_url(
                    self._root.replace(self.scheme, scheme, 1),
                    config=config,
                    client_options={
                        "allow_http": address.startswith("http://"),
                        "connect_timeout": silence,
                        **limit,
                    },
                    retry_config={"max_retries": 0},
                    credential_provider=provider,
                )
                for limit in limits
            )
        except library.exceptions.UnknownConfigurationKeyError as error:
            name = str(error).split("'")[1]
            raise ArgumentError(
                name,
                expected="a storage option",
                found="a name that the store does not know",
                advice="see the page on storage",
            ) from None
        except (library.exceptions.BaseError, ValueError, TypeError):
            raise CarlascError(
                without_credentials(self.url),
                problem="cannot be opened",
                advice="check the URL and the storage options",
            ) from None
        return reading, writing

    @staticmethod
    def _provider(config: dict[str, Any]) -> Any:
        """Return what finds credentials, unless they are given, or in variables that obstore reads;
        set the endpoint and the region. Credentials of ~/.aws may name roles and programs, so boto3
        finds them.
        """
        if address := _variable("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL"):
            config.setdefault("endpoint", address)
        profile = config.pop("profile", None) or _variable("AWS_PROFILE")
        given = "access_key_id" in config or str(config.get("skip_signature")).lower() == "true"
        if given or (not profile and _variable("AWS_ACCESS_KEY_ID")):
            return None
        session = import_extra("boto3", "remote").Session(profile_name=profile or None)
        if session.get_credentials() is None:
            return None
        region = _variable("AWS_REGION", "AWS_DEFAULT_REGION") or session.region_name
        config.setdefault("region", region or "us-east-1")
        _library()
        return importlib.import_module("obstore.auth.boto3").Boto3CredentialProvider(session)

    def _key(self, url: str) -> str:
        return url[len(self._root) :].strip("/")

    def get(self, url: str, start: int | None = None, end: int | None = None) -> bytes:
        """Return bytes of an object. obstore compares the range that it receives.

        A whole object is requested as the range from its first byte: that answer names the size of
        the object, so that a short one is noticed.
        """
        store = self.connection[0]
        key = self._key(url)
        try:
            if start is not None and end is not None:
                return bytes(_library().get_range(store, key, start=start, end=end))
            answer = _library().get(store, key, options={"range": {"offset": 0}})
            data = bytes(answer.bytes())
        except Exception as error:
            if status_and_code(error)[0] == 416:  # also for an empty object
                return b""
            raise
        if len(data) != answer.meta["size"]:
            raise WrongAnswerError(f"{len(data)} bytes instead of {answer.meta['size']}")
        return data

    def about(self, url: str) -> tuple[int, str] | None:
        """Describe an object."""
        store = self.connection[0]
        key = self._key(url)
        if not key:
            return None
        try:
            about = _library().head(store, key)
        except FileNotFoundError:
            try:  # the answer to HEAD does not say whether the bucket exists
                _library().get(store, key)
            except FileNotFoundError as error:
                if status_and_code(error)[1] == "NoSuchBucket":
                    raise
            return None
        return _described(about)

    def entries(self, url: str) -> dict[str, bool]:
        """List a folder."""
        key = self._key(url)
        listed = _library().list_with_delimiter(self.connection[0], key)
        places = dict.fromkeys(listed["common_prefixes"], True)
        places |= dict.fromkeys([entry["path"] for entry in listed["objects"]], False)
        places.pop(key, None)  # some programs store an object for the folder itself
        return {place.rstrip("/").rpartition("/")[2]: folder for place, folder in places.items()}

    def files(self, url: str) -> dict[str, tuple[int, str]]:
        """List all objects below a folder."""
        key = self._key(url)
        listed = _library().list(self.connection[0], key).collect()
        if not listed and (about := self.about(url)) is not None:
            return {"": about}
        return {
            entry["path"].removeprefix(key).lstrip("/"): _described(entry)
            for entry in listed
            if entry["path"] != key
        }

    def put(self, url: str, data: bytes, mark: str | None = None) -> bool:
        """Write an object with one request, or in parts if it is large and replaces another.

        If the answer to a create-only put is lost, the put is sent again and finds its own object:
        it has the mark.
        """
        library = _library()
        store = self.connection[1]
        key = self._key(url)
        if mark is None:
            library.put(store, key, data, chunk_size=_PART_BYTES)
            return True
        try:
            library.put(store, key, data, mode="create", attributes={_MARK: mark})
        except library.exceptions.AlreadyExistsError:
            try:
                attributes = library.get(self.connection[0], key, options={"head": True}).attributes
            except FileNotFoundError:  # it was removed meanwhile
                return False
            return bool(attributes.get(_MARK) == mark)
        return True

    def remove(self, urls: Iterable[str]) -> None:
        """Remove objects, in S3 1000 per request."""
        keys = [self._key(url) for url in urls]
        store = self.connection[1]
        if self.scheme in _S3:
            _library().delete(store, keys)
            return
        for key in keys:  # other stores fail for an object that does not exist
            try:
                _library().delete(store, key)
            except FileNotFoundError:
                continue


def _described(about: Any) -> tuple[int, str]:
    """Return the size and the version of an object."""
    return about["size"], f"{about['e_tag'] or ''} {about['last_modified']}"


def _variable(*names: str) -> str:
    """Return the first environment variable that is set; otherwise an empty string."""
    return next(filter(None, map(os.environ.get, names)), "")


_owners: list[int] = []  # processes with threads of obstore of their own: this one and its parents
_locks: dict[int, threading.Lock] = {}  # by process: a lost thread may hold that of a parent


def _library() -> ModuleType:
    """Return obstore; in a forked process a second copy of it.

    Its threads (of tokio) do not survive a fork: a request in the child would wait for ever, and
    the loaders of PyTorch fork their workers. They belong to the loaded file, so that a copy of the
    file, which needs no name on Linux, has threads of its own.

    Raises:
        CarlascError: the threads were lost, on a system other than Linux.
    """
    process = os.getpid()
    with _locks.setdefault(process, threading.Lock()):
        if process not in _owners:
            if _owners:
                _load_copy()
            _owners.append(process)
        importlib.import_module("obstore.store")
        return sys.modules["obstore"]


def _load_copy() -> None:
    make_file = getattr(os, "memfd_create", None)  # of Linux
    if make_file is None:
        raise CarlascError(
            "a forked process",
            problem="cannot send requests to object stores",
            advice='start processes with the method "spawn"',
        )
    installed = str(sys.modules[PRIVATE].__file__)
    for name in [name for name in sys.modules if name.partition(".")[0] == "obstore"]:
        del sys.modules[name]
    with open(make_file("obstore"), "wb") as file:
        file.write(Path(installed).read_bytes())
        file.flush()
        loader = ExtensionFileLoader(PRIVATE, f"/proc/self/fd/{file.fileno()}")
        module = module_from_spec(ModuleSpec(PRIVATE, loader, origin=loader.path))
        sys.modules[PRIVATE] = module
        loader.exec_module(module)
    module.__file__ = installed
