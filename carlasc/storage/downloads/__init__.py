"""Downloading the published zips: their list (`archives`), transfer (`transfer`), and extraction (`extraction`)."""

from carlasc.storage.downloads.fetching import Downloaded, DownloadResult, download
from carlasc.storage.downloads.transfer import TransferSettings

__all__ = ["DownloadResult", "Downloaded", "TransferSettings", "download"]
