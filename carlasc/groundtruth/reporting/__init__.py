"""The report of a grid: what is in it, how it was made, and digests by which a later change is noticed."""
