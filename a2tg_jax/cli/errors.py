"""tyro's errors as lines that say what to type."""

import re
from collections.abc import Callable

UNRECOGNIZED = "Unrecognized options: "
EXAMPLES = {"--out": "--out runs/NAME"}
"""Values that show how a missing flag is typed."""


def plain(told: str) -> str:
    """Return an error of tyro, on one line, in plain words."""
    missing = re.fullmatch(r"Missing from [^:]+: (.*)", told)
    if missing:
        return "; ".join(_told_missing(part.strip()) for part in missing[1].split("(required)") if part.strip())
    told = re.sub(r"^Missing value for argument '([^']+)'\. Expected .*", r"\1 wants a value", told)
    told = re.sub(r"^Error parsing ([^:]+): (wants )", r"\1 \2", told)
    choice = re.fullmatch(r"invalid choice ('.*') for argument '([^']+)'\. Expected one of \((.*)\)", told)
    if choice:
        return f"{choice[2]} wants one of {choice[3].replace(chr(39), '').rstrip(',')}; got {choice[1]}"
    return told


def _told_missing(part: str) -> str:
    """Return what is missing, from a flag or a metavar, followed by its help."""
    name, _, rest = part.partition(" ")
    help_text = rest.partition(" ")[2] if name.startswith("--") else rest
    words = help_text.rstrip(". ")
    if words[1:2].islower():
        words = words[0].lower() + words[1:]
    example = f", for example {EXAMPLES[name]}" if name in EXAMPLES else ""
    return f"{name} is missing: {words}{example}"


def unknown_words(told: str) -> list[str]:
    """Return the words that an error lists as unrecognised, without the values of unknown flags."""
    kept: list[str] = []
    is_value = False
    for word in told.removeprefix(UNRECOGNIZED).split(", "):
        is_flag = word.startswith("--")
        if is_flag or not is_value:
            kept.append(word)
        is_value = (is_flag and "=" not in word) or (is_value and not is_flag)
    return kept


def told_unknown(words: list[str], suggested: Callable[[str], str]) -> str:
    """Return the error of unrecognised words, with what is suggested for the first flag among them."""
    flags = [word.partition("=")[0] for word in words if word.startswith("--")]
    hint = suggested(flags[0]) if flags else ""
    return f"{UNRECOGNIZED}{', '.join(words)}{hint}"
