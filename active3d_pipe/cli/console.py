"""Printing: one JSON document or plain text to stdout, everything else to stderr."""

import json
import os
import sys
from collections.abc import Iterable, Sequence
from typing import Any, TextIO


def say(text: str) -> None:
    """One line for the user, on stderr."""
    _print(text, sys.stderr)


def out(text: str) -> None:
    """The answer to a command, on stdout."""
    _print(text, sys.stdout)


def _print(text: str, stream: TextIO) -> None:
    """Print at once; when the reader has gone (`| head`), this and all that follows goes nowhere."""
    try:
        print(text, file=stream, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def out_json(document: Any) -> None:
    """The answer as the one JSON document on stdout."""
    out(json.dumps(document, indent=2))


def table(rows: Iterable[Sequence[str]], header: Sequence[str] = ()) -> str:
    """Columns of text, numbers to the right, as wide as they need to be."""
    lines = [list(row) for row in rows]
    everything = [list(header), *lines] if header else lines
    widths = [max(len(row[i]) for row in everything) for i in range(len(everything[0]))] if everything else []
    right = [all(_is_number(row[i]) for row in lines) for i in range(len(widths))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(row, widths, right, strict=True)
        ).rstrip()
        for row in everything
    )


def size(count: int) -> str:
    """Bytes for people: 0 B, 12.3 MB."""
    value = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000 or unit == "GB":
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    raise AssertionError("unreachable")


def seconds(value: float) -> str:
    """A duration for people: 4.2 s, 3 min 05 s, 2 h 10 min."""
    if value < 60:
        return f"{value:.1f} s"
    if value < 3600:
        return f"{int(value) // 60} min {int(value) % 60:02d} s"
    return f"{int(value) // 3600} h {int(value) % 3600 // 60:02d} min"


def number(value: Any) -> str:
    """A note for people: floats with four digits, lists shortened."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return f"[{', '.join(number(item) for item in value[:6])}{', ...' if len(value) > 6 else ''}]"
    return str(value)


def flat_notes(notes: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Notes as rows of a table; nested tables become dotted names."""
    rows: list[tuple[str, str]] = []
    for name, value in notes.items():
        if isinstance(value, dict):
            rows += flat_notes(value, f"{prefix}{name}.")
        else:
            rows.append((f"{prefix}{name}", number(value)))
    return rows


def _is_number(text: str) -> bool:
    return text[:1].isdigit() or text in ("", "-") or (text[:1] == "-" and text[1:2].isdigit())
