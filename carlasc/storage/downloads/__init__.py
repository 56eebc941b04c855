"""Fetching the published zips: what there is (`archives`), how it comes here whole (`transfer`), unpacking (`extraction`)."""

from carlasc.storage.downloads.fetching import Downloaded, DownloadResult, download

__all__ = ["DownloadResult", "Downloaded", "download"]
