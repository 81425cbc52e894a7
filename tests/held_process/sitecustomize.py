"""Holds processes where they make a certain file or folder; Python runs this first where its path says so.

Before a process makes what the pattern ``HELD_AT`` fits, it leaves a file in the folder ``HELD_IN``, and
stands still as long as that folder is there. So what a test does to it depends on no machine's speed.
"""

import os
import re
import sys
import time
from typing import Any


def _hold(event: str, arguments: tuple[Any, ...]) -> None:
    if event not in ("open", "os.mkdir") or not re.search(os.environ["HELD_AT"], str(arguments[0])):
        return
    if os.path.isdir(os.environ["HELD_IN"]):
        open(os.path.join(os.environ["HELD_IN"], str(os.getpid())), "w").close()
    while os.path.isdir(os.environ["HELD_IN"]):
        time.sleep(0.05)


sys.addaudithook(_hold)
