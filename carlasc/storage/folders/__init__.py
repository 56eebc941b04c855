"""The published layout as files: in a folder, in a zip, behind a URL."""
