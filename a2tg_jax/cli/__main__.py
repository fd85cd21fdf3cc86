"""`python -m a2tg_jax.cli`, the command `a2tg`."""

import sys

from a2tg_jax.host import signals


def main() -> int:
    """Run the command line. A signal during the imports, which take a second, ends it in one line, too."""
    try:
        with signals.raised():
            from a2tg_jax.cli.main import main as run
        return run()
    except KeyboardInterrupt as stop:
        print("a2tg: interrupted", file=sys.stderr)
        return signals.Stopped.of(stop).exit_code


if __name__ == "__main__":
    sys.exit(main())
