"""Run the command `carlasc` with `python -m carlasc`."""

from carlasc.cli import main

main()
