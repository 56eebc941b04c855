"""Files of the Hugging Face Hub (`hf://datasets/ORG/NAME/...`), fetched with one request each.

huggingface_hub's file system lists and describes files, with retries of its own, which nothing turns off. Files are fetched here, so that answers
are checked and failed requests are sent again as for all other servers.
"""

from __future__ import annotations

from typing import Any

from carlasc.errors import import_extra
from carlasc.storage.folders.bodies import WrongAnswerError, check_range

HUB = "hf"
"""The scheme of its URLs."""


def get_from_hub(fs: Any, url: str, timeout_s: float, start: int | None = None, end: int | None = None) -> bytes:
    """Return the bytes [start, end) of a file, or the whole file.

    Raises:
        FileNotFoundError: the file does not exist.
        WrongAnswerError: the server sent something else.
        OSError: the request failed (an error of huggingface_hub).
    """
    hub = import_extra("huggingface_hub.utils", "hub")
    headers = dict(hub.build_hf_headers(token=fs.token))
    if start is not None and end is not None:
        headers["Range"] = f"bytes={start}-{end - 1}"
    answer = hub.get_session().get(fs.url(url), headers=headers, timeout=timeout_s)
    if answer.status_code == 416:  # the range starts behind the end of the file
        return b""
    if answer.status_code == 404:
        raise FileNotFoundError(url)
    hub.hf_raise_for_status(answer)
    if start is not None:
        if answer.status_code != 206:
            raise WrongAnswerError("the whole file instead of a range")
        check_range(answer.headers.get("Content-Range"), start, end)
    return bytes(answer.content)


def is_offline(error: BaseException) -> bool:
    """Whether the Hub was not asked, because the environment variable HF_HUB_OFFLINE forbids it."""
    return type(error).__name__ == "OfflineModeIsEnabled"
