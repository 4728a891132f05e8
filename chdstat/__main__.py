"""The command line as ``python -m chdstat``, where no script was installed."""

from chdstat.cli import main

if __name__ == "__main__":
    main()
