"""`python -m vehest_papers.scorecard`."""

from vehest_papers.scorecard.files import main

main()
