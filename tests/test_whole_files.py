"""Files that appear complete or not at all."""

import pytest

from lerobot_swr.whole_files import replacing, write_whole


def test_a_file_is_replaced_with_its_folder_made(tmp_path):
    """Text and bytes; nothing else is left beside it."""
    path = tmp_path / "new" / "file.json"
    write_whole(path, "größer")
    assert path.read_bytes() == "größer".encode()
    write_whole(path, b"\x00\xff")
    assert path.read_bytes() == b"\x00\xff"
    assert list(path.parent.iterdir()) == [path]


def test_after_an_error_the_old_file_stays(tmp_path):
    """Half-written content disappears, and the error goes on."""
    path = tmp_path / "file"
    write_whole(path, "old")

    def fail(unfinished):
        unfinished.write_text("ha")
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space"), replacing(path) as unfinished:
        fail(unfinished)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
