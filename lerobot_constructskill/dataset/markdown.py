"""Cards: what is written on them comes from files that anybody may have written, and is only ever text there."""

import re
from importlib.resources import files
from typing import Any

ACTIVE = re.compile(r"[\x00-\x1f`]|\]\(")
"""What would end a line, a piece of code or a link's name; HTML is escaped beside it."""


def render(template: str, **facts: Any) -> str:
    """A template of this folder with its facts filled in."""
    from jinja2 import Environment, StrictUndefined

    layout = {"trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(undefined=StrictUndefined, autoescape=True, finalize=_plain, **layout)
    return environment.from_string(files(__package__).joinpath(template).read_text(encoding="utf-8")).render(**facts)


def _plain(value: Any) -> Any:
    return ACTIVE.sub(" ", value) if type(value) is str else value
