"""`python -m ExpectedAppearancesLib COMMAND`."""

# Guarded: worker processes that are spawned import this file again.
if __name__ == "__main__":
    import sys

    from ExpectedAppearancesLib.cli import main

    sys.exit(main())
