"""`python -m a2tg_jax.cli`, the command `a2tg`."""

import sys

INTERRUPTED = 128 + 2
"""Exit code after Ctrl-C."""


def main() -> int:
    """Run the command line; Ctrl-C during its imports, which take a second, ends it in one line, too."""
    try:
        from a2tg_jax.cli.main import main as run

        return run()
    except KeyboardInterrupt:
        print("a2tg: interrupted", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
