"""Templates of the pages. Values are escaped as text unless they are marked as markup."""

from __future__ import annotations

import re

import jinja2
from markupsafe import Markup, escape


def page_template(name: str, package: str = "pipeline.report") -> jinja2.Template:
    """A template of a package, which may include those of `pipeline.report`; the filter `code` renders backticks."""
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(package), jinja2.PackageLoader("pipeline.report")]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["code"] = _code
    return environment.get_template(name)


def _code(text: str) -> Markup:
    """One line of Markdown as HTML, with text between backticks as code."""
    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text))))  # noqa: S704 -- escaped
