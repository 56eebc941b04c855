"""The figures of the documentation: what measures them, the file that keeps them, and the places in
the pages that show them.

`make figures` measures all of them, writes docs/figures.json, and fills the pages in; `python -m
measuring --help` does parts of it.
"""
