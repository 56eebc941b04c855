"""The only place that opens or sends files: trees that are read, targets that are written, requests, a cache, zips."""
