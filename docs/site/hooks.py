"""What the documentation's generator does with a page beyond Markdown."""

import re
from typing import Any


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """Let ``bash long``, which tells `.ci/readme_commands.py` to skip a block, be ``bash``."""
    return re.sub(r"^(\s*```bash) long$", r"\1", markdown, flags=re.MULTILINE)
