"""What pyproject.toml cannot say: README.md for a package index, where links into the repository have to be absolute.

Once ``[project.urls]`` names a ``Repository``, pictures and links of README.md lead to it, at the tag of this version.
"""

import re
import tomllib
from pathlib import Path

from setuptools import setup

HERE = Path(__file__).resolve().parent
LINK = re.compile(r'(?P<before>\]\(|\b(?:src|srcset|href)=")(?P<to>(?![a-z]+:|#|/)[^)"\s]+)')
PICTURES = (".gif", ".png")


def described(readme: str, repository: str | None, version: str) -> str:
    """README.md with its relative links led to the tag ``v<version>`` of a repository; as it is without one."""
    if repository is None:
        return readme

    def absolute(found: re.Match[str]) -> str:
        kind = "raw" if found["to"].partition("#")[0].endswith(PICTURES) else "blob"
        return f"{found['before']}{repository.rstrip('/')}/{kind}/v{version}/{found['to']}"

    return LINK.sub(absolute, readme)


if __name__ == "__main__":
    project = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = described(
        (HERE / "README.md").read_text(encoding="utf-8"), project.get("urls", {}).get("Repository"), project["version"]
    )
    setup(long_description=text, long_description_content_type="text/markdown")
