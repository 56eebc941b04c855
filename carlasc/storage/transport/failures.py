"""Classification of failed requests: whether a request may succeed later, and the error message for
the user.

fsspec passes on the errors of other libraries, which share no base class. `TEMPORARY` lists their
public classes for failed connections.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from typing import NoReturn

from carlasc.errors import CarlascError, MissingDataError, StorageError

TEMPORARY: Mapping[str, tuple[str, ...]] = {
    "urllib3.exceptions": ("TimeoutError", "ProtocolError", "NewConnectionError", "SSLError"),
    "requests.exceptions": ("ConnectionError", "ChunkedEncodingError"),
    "http.client": ("IncompleteRead",),
    "httpx": ("TransportError",),
    "httpx2": ("TransportError",),
}
"""Connection errors by module. Only modules that are already imported can have raised an error."""

# statuses below 500 after which a request may succeed later
_BUSY = frozenset({408, 409, 425, 429})
# of the messages of obstore, only these parts are read: they may hold a signature or a key
_STATUS = re.compile(r"status code: ([0-9]{3})")
_CODE = re.compile(r"<Code>(\w+)</Code>")
# the address at which machines of a cloud ask for credentials
_METADATA_SERVICE = "169.254.169.254"


class WrongAnswerError(Exception):
    """The answer of a server does not fit the request. The request is sent again."""


class WholeFileError(WrongAnswerError):
    """The answer of a server that has no ranges: the whole file. The request is not sent again."""


class StatusError(Exception):
    """A web server answered with a status of 300 or more.

    Attributes:
        status: the HTTP status.
    """

    def __init__(self, status: int) -> None:
        super().__init__(f"status {status}")
        self.status = status


def is_temporary(error: BaseException) -> bool:
    """Whether a request that failed with an error may succeed when it is sent again."""
    if is_offline(error) or isinstance(error, WholeFileError):
        return False
    if _is_of_connection(error):
        return True
    status, _ = status_and_code(error)
    if status is not None:
        return status in _BUSY or (status >= 500 and status != 501)  # 501: not implemented
    if _is_of_obstore(error):
        return type(error).__name__ == "GenericError" and not _lacks_credentials(error)
    return isinstance(error, WrongAnswerError | TimeoutError | ConnectionError)


def is_offline(error: BaseException) -> bool:
    """Whether no request was sent to the Hub, because the environment variable HF_HUB_OFFLINE is
    set.
    """
    return type(error).__name__ == "OfflineModeIsEnabled"


def fail(where: str, error: BaseException, *, writing: bool = False) -> NoReturn:
    """Raise the error of a request with a message of one line without credentials.

    Messages of other libraries are left out, because they may contain a signature or a key. For the
    same reason, the error has no cause.

    Args:
        where: the file, without credentials.
        error: the error of the request.
        writing: whether it was a request to write the file.

    Raises:
        MissingDataError: the file or the bucket does not exist.
        StorageError: the file cannot be written (if `writing`).
        CarlascError: anything else.
    """
    if isinstance(error, CarlascError):
        raise error
    status, code = status_and_code(error)
    kind, missing = (StorageError,) * 2 if writing else (CarlascError, MissingDataError)
    if code == "NoSuchBucket":
        raise missing(
            where,
            expected="a bucket that exists",
            found="no such bucket",
            advice="check the name of the bucket, or create it",
        ) from None
    if isinstance(error, FileNotFoundError) and not writing:
        raise MissingDataError(where, expected="a file", found="nothing") from None
    if isinstance(error, WholeFileError):
        raise CarlascError(
            where,
            expected="a server that supports range requests",
            found="a server without them",
            advice="download the file first",
        ) from None
    refused = isinstance(error, PermissionError) or status in (401, 403)
    failure = describe_failure(error)
    reasons = (
        (
            _lacks_credentials(error),
            "no credentials were found",
            "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or FSSPEC_S3_ANON=true for a public "
            "bucket",
        ),
        (
            "incorrectly configured region" in str(error),
            "the bucket is in another region",
            "set AWS_REGION to the region of the bucket",
        ),
        (
            refused,
            f"access was refused ({code or status or 'no permission'})",
            "check the credentials and their permissions",
        ),
        (is_offline(error), "HF_HUB_OFFLINE is set", "unset it to use the network"),
        (
            is_temporary(error),
            f"the server failed at each attempt, last with {failure}",
            "try again later",
        ),
        (True, failure, ""),
    )
    problem, advice = next(reason for applies, *reason in reasons if applies)
    verb = "cannot be written" if writing else "cannot be read"
    raise kind(where, problem=f"{verb}: {problem}", advice=advice) from None


def describe_failure(error: BaseException) -> str:
    """Describe an error of a request without credentials: its status, its code or the name of its
    class.
    """
    status, code = status_and_code(error)
    if isinstance(error, WrongAnswerError):
        return str(error)
    if _is_of_obstore(error) and status is None:
        return "no answer, or one that does not fit the request"
    if status:
        return f"{status} {code}".strip()
    name = type(error).__name__
    reason = getattr(error, "strerror", None)
    return f"{name} ({reason})" if reason and isinstance(error, OSError) else name


def _is_of_obstore(error: BaseException) -> bool:
    return type(error).__module__ == "obstore.exceptions"


def _lacks_credentials(error: BaseException) -> bool:
    return _METADATA_SERVICE in str(error)


def _is_of_connection(error: BaseException) -> bool:
    """Whether an error, or one of its causes, is a connection error."""
    kinds = tuple(
        getattr(sys.modules[module], name)
        for module, names in TEMPORARY.items()
        if module in sys.modules
        for name in names
        if hasattr(sys.modules[module], name)
    )
    return any(isinstance(cause, kinds) for cause in _causes(error))


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__


def status_and_code(error: BaseException) -> tuple[int | None, str]:
    """Return the HTTP status of an error, and the code of an S3 error ("NoSuchBucket"), if it has
    them.
    """
    for cause in _causes(error):
        if match := _STATUS.search(str(cause)):  # obstore; its missing objects are not its errors
            code = _CODE.search(str(cause))
            return int(match[1]), code[1] if code else ""
        answer = getattr(cause, "response", None)
        for holder, name in ((cause, "status"), (cause, "code"), (answer, "status_code")):
            status = getattr(holder, name, None)
            if isinstance(status, int) and 100 <= status < 600:
                return status, ""
    return None, ""
