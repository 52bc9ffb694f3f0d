"""What `aftbed bench paper` refuses before anything is measured."""

from pathlib import Path

from playedrun import Run


def test_two_forms_at_once(refused: Run) -> None:
    assert "--json and --markdown: one of them is allowed" in refused(
        "bench", "paper", "--json", "--markdown"
    )


def test_a_page_in_no_directory(refused: Run, tmp_path: Path) -> None:
    page = tmp_path / "gone" / "page.html"
    assert f"--html {page}: {page.parent} is no directory" in refused("bench", "paper", "--html", page)


def test_a_directory_for_a_page(refused: Run, tmp_path: Path) -> None:
    assert "the name of a file is allowed" in refused("bench", "paper", "--html", tmp_path)
