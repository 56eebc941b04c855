"""`python -m carlasc` is `carlasc`."""

from carlasc.cli import main

main()
