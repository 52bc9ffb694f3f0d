"""`aftbed bench`: what it refuses before anything is measured."""

from pathlib import Path

from fakerun import Output


def test_json_and_markdown_exclude_each_other(refused: Output) -> None:
    assert "--json and --markdown: one of them is allowed" in refused(
        "bench", "paper", "--json", "--markdown"
    )


def test_a_page_in_a_directory_that_does_not_exist(refused: Output, tmp_path: Path) -> None:
    page = tmp_path / "gone" / "page.html"
    assert f"--html {page}: {page.parent} is no directory" in refused("bench", "paper", "--html", page)


def test_a_page_that_is_a_directory(refused: Output, tmp_path: Path) -> None:
    assert "the name of a file is allowed" in refused("bench", "paper", "--html", tmp_path)


def test_a_page_without_the_markers_of_the_table(refused: Output, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Numbers\n")
    assert f"--into {page}: it needs the lines" in refused("bench", "all", "--into", page)
