"""The command line as `python -m vibrissa`, where no script is on the path."""

from vibrissa.cli import main

if __name__ == "__main__":
    main()
