"""Templates of the pages: what is put into them is text and never markup, unless it says that it is."""

from __future__ import annotations

import re

import jinja2
from markupsafe import Markup, escape


def page_template(name: str) -> jinja2.Template:
    """A template by its file name; the filter `code` sets what stands between backticks."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pipeline.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["code"] = _code
    return environment.get_template(name)


def _code(text: str) -> Markup:
    """One line of Markdown as HTML: what stands between backticks is code."""
    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text))))  # noqa: S704 -- escaped
