"""A report from tables and pictures: one self-contained HTML page, or Markdown beside its pictures."""

import base64
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment

from lerobot_swr.whole_files import write_whole

TEMPLATE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
  body { font: 16px/1.55 system-ui, sans-serif; max-width: 80rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; }
  h1 { font-size: 1.7rem; } h2 { font-size: 1.25rem; margin-top: 2.2rem; }
  img { max-width: 100%; display: block; }
  figure { margin: 1.2rem 0; } figcaption, .note { color: #555; font-size: .9rem; }
  .scroll { overflow-x: auto; }
  table { border-collapse: collapse; margin: 1rem 0; font-size: .9rem; }
  th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid #ddd; white-space: pre;
  vertical-align: top; line-height: 1.35; }
  th:first-child, td:first-child { text-align: left; } thead th { border-bottom: 2px solid #888; }
  pre { background: #f5f5f5; padding: .8rem; overflow-x: auto; font-size: .82rem; }
</style>
</head>
<body>
<h1>{{ title }}</h1>
<p>{{ introduction }}</p>
{% for section in sections %}
<h2>{{ section.title }}</h2>
{% for paragraph in section.text %}
<p>{{ paragraph }}</p>
{% endfor %}
{% for table in section.tables %}
<p class="note">{{ table.caption }}</p>
<div class="scroll"><table>
<thead><tr>{% for cell in table.header %}<th>{{ cell }}</th>{% endfor %}</tr></thead>
<tbody>
{% for row in table.rows %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody>
</table></div>
{% endfor %}
{% for figure in section.figures %}
<figure><img src="data:image/png;base64,{{ figure.png }}" alt="{{ figure.caption }}">
<figcaption>{{ figure.caption }}</figcaption></figure>
{% endfor %}
{% endfor %}
<h2>How this was made</h2>
<pre>{{ commands | join("\n") }}</pre>
<p class="note">{{ versions }}</p>
</body>
</html>
"""

MARKDOWN = """# {{ title }}

{{ introduction | text }}
{% for section in sections %}

## {{ section.title | text }}
{% for paragraph in section.text %}

{{ paragraph | text }}
{% endfor %}
{% for table in section.tables %}

{{ table.caption | text }}

| {{ table.header | map("text") | join(" | ") }} |
|{{ "---|" * table.header | length }}
{% for row in table.rows %}
| {{ row | map("text") | join(" | ") }} |
{% endfor %}
{% endfor %}
{% for figure in section.figures %}

![{{ figure.path.stem }}]({{ figure | place }})

{{ figure.caption | text }}
{% endfor %}
{% endfor %}

## How this was made

```bash
{{ commands | join("\n") }}
```

{{ versions | text }}
"""


@dataclass(frozen=True)
class Table:
    """A table: what it shows, the heads of its columns, and its cells."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Picture:
    """A PNG file and what it shows."""

    caption: str
    path: Path

    @property
    def png(self) -> str:
        """The file's content, base64-encoded."""
        return base64.b64encode(self.path.read_bytes()).decode()


@dataclass(frozen=True)
class Section:
    """A heading, then paragraphs, then tables, then pictures."""

    title: str
    tables: Sequence[Table]
    figures: Sequence[Picture]
    text: Sequence[str] = ()


def write_report(
    path: Path,
    title: str,
    introduction: str,
    sections: Sequence[Section],
    commands: Sequence[str],
    versions: str,
) -> None:
    """Write the page; it needs no other file.

    Args:
        path: The HTML file.
        title: Heading of the page.
        introduction: A paragraph below it.
        sections: The page's body.
        commands: What to type to make the results again.
        versions: Software versions.
    """
    template = Environment(autoescape=True).from_string(TEMPLATE)
    page = template.render(
        title=title, introduction=introduction, sections=sections, commands=commands, versions=versions
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, page)


def write_markdown(
    path: Path,
    title: str,
    introduction: str,
    sections: Sequence[Section],
    commands: Sequence[str],
    versions: str,
) -> None:
    """Write the same as `write_report` in Markdown, with links to the pictures.

    Args:
        path: The Markdown file.
        title: Heading of the page.
        introduction: A paragraph below it.
        sections: The page's body.
        commands: What to type to make the results again.
        versions: Software versions.
    """
    environment = Environment(trim_blocks=True)
    environment.filters["text"] = lambda text: (
        text.replace("*", r"\*").replace("|", r"\|").replace("~", r"\~").replace("\n", "<br>")
    )
    environment.filters["place"] = lambda figure: os.path.relpath(figure.path, path.parent)
    page = environment.from_string(MARKDOWN).render(
        title=title, introduction=introduction, sections=sections, commands=commands, versions=versions
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, page.rstrip() + "\n")
