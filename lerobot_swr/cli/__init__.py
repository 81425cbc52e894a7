"""The `lerobot-swr-*` commands: thin draccus entry points, one module each."""
