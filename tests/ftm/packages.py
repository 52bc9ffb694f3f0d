"""Installed packages for tests: a directory on the path, with metadata as pip writes them."""

import importlib
import tomllib
from pathlib import Path

from aftbed.cli.init import write_mechanism
from aftbed.core.installed import entry_points


def install(site: Path, package: str, points: dict[str, str], **modules: str) -> None:
    """Put a package into `site`, with entry points of mechanisms, and the text of its modules."""
    about = site / f"{package.replace('-', '_')}-0.1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 0.1.0\n")
    lines = (f"{name} = {place}\n" for name, place in points.items())
    (about / "entry_points.txt").write_text("[aftbed.mechanisms]\n" + "".join(lines))
    for module, text in modules.items():
        (site / f"{module}.py").write_text(text)
    importlib.invalidate_caches()
    entry_points.cache_clear()


def install_new(site: Path, name: str, folder: Path) -> Path:
    """Install what `aftbed init mechanism` writes into `folder`, by its own pyproject.toml."""
    project = write_mechanism(name, folder)
    about = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    module = f"aftbed_{name}"
    text = (project / module / "__init__.py").read_text()
    install(site, about["name"], about["entry-points"]["aftbed.mechanisms"], **{module: text})
    return project
