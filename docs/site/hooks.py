"""What the documentation's generator does with a page beyond Markdown."""

import re
from typing import Any


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """Let ``bash long``, which tells `.ci/readme_commands.py` to skip a block, be ``bash``.

    Links to files of ``configs/``, which are no pages, lead to the page that shows them.
    """
    markdown = re.sub(r"^(\s*```bash) long$", r"\1", markdown, flags=re.MULTILINE)
    return re.sub(r"\]\(\.\./configs[^)]*\)", "](recipes.md)", markdown)


SHIM = '<script src="https://unpkg.com/iframe-worker/shim"></script>'  # the theme's, for search in files


def on_post_page(output: str, page: Any, **kwargs: Any) -> str:
    """Let search in files be this site's own script's work, not that of another host.

    Raises:
        ValueError: If the page still asks another host for something to run or to show.
    """
    output = output.replace(
        SHIM, f'<script src="{"../" * page.url.count("/")}site/frame_worker.js"></script>'
    )
    foreign = re.findall(
        r'<(?:script|img|link rel="stylesheet")[^>]* (?:src|href)="(https?://[^"]+)"', output
    )
    if foreign:
        raise ValueError(f"{page.url}: asks other hosts for {', '.join(foreign)}")
    return output


def on_post_template(output_content: str, **kwargs: Any) -> str:
    """The same of the page that says that there is none."""
    return output_content.replace(SHIM, "")
