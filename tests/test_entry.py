"""The entry point of the command line: a signal during the imports ends it in one line."""

import signal
import sys
from types import ModuleType

import pytest

from a2tg_jax.cli import __main__ as entry


class Interrupted(ModuleType):
    """A module of the command line during whose import a signal comes."""

    number = signal.SIGINT

    def __getattr__(self, name):
        if name == "main":
            signal.raise_signal(self.number)
        raise AttributeError(name)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_during_the_imports_ends_the_program_in_one_line(monkeypatch, capsys, number, code):
    module = Interrupted("a2tg_jax.cli.main")
    module.number = number
    monkeypatch.setitem(sys.modules, "a2tg_jax.cli.main", module)
    assert entry.main() == code
    assert capsys.readouterr().err == "a2tg: interrupted\n"


def test_otherwise_the_command_line_runs(monkeypatch):
    module = ModuleType("a2tg_jax.cli.main")
    module.main = lambda: 7
    monkeypatch.setitem(sys.modules, "a2tg_jax.cli.main", module)
    assert entry.main() == 7
