"""Packed stores of Parquet tables. The format is described in docs/storage.md, section "Tables"."""
