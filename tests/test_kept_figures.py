"""Figures of scripts that measure for long: kept as they come, never measured twice."""

import pytest
from lab.kept import KeptFigures


def table(found):
    return "\n".join(f"{key}: {figures['psnr']}" for key, figures in found.items())


def test_a_second_call_goes_on_where_the_first_was_stopped(tmp_path, capsys):
    measured = []

    def measure(name):
        measured.append(name)
        if name == "stop":
            raise KeyboardInterrupt
        return {"psnr": 20.123}

    kept = KeptFigures(tmp_path / "new", "few", table)
    kept.measure("a", lambda: measure("a"))
    with pytest.raises(KeyboardInterrupt):
        kept.measure("b", lambda: measure("stop"))
    again = KeptFigures(tmp_path / "new", "few", table)
    assert again.has_all(["a"]) and not again.has_all(["a", "b"])
    for name in "ab":
        again.measure(name, lambda name=name: measure(name))
    assert measured == ["a", "stop", "b"]
    assert (tmp_path / "new" / "few.md").read_text() == again.table() == "a: 20.123\nb: 20.123"
    assert "a {'psnr': 20.12}" in capsys.readouterr().out
