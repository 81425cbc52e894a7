"""What the documentation's generator does with a page beyond Markdown."""

import re
from typing import Any


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """Let ``bash long``, which tells `.ci/readme_commands.py` to skip a block, be ``bash``.

    Links to files of ``configs/``, which are no pages, lead to the page that shows them.
    """
    markdown = re.sub(r"^(\s*```bash) long$", r"\1", markdown, flags=re.MULTILINE)
    return re.sub(r"\]\(\.\./configs[^)]*\)", "](recipes.md)", markdown)
