"""Run the command line with `python -m orthocas`."""

from orthocas.cli import main

if __name__ == "__main__":
    main()
