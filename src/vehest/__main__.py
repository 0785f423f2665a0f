"""``python -m vehest``."""

from vehest.cli import main

main()
