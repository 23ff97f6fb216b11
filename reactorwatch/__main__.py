"""`python -m reactorwatch` is the command `reactorwatch`."""

from reactorwatch.cli.main import main

if __name__ == "__main__":
    main()
