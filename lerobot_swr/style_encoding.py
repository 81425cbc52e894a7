"""`lerobot_swr.styles.encoding` under its name of version 0.1, for code that imports it from here."""

from lerobot_swr.styles.encoding import encode_styles

__all__ = ["encode_styles"]
