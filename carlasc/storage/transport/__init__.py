"""All access to files and servers: trees to read, targets to write, requests, a cache, zips.

No other package opens or sends files.
"""
