"""`python -m vehest_papers.scorecard`."""

from vehest_papers.scorecard.files import main

if __name__ == "__main__":
    main()
