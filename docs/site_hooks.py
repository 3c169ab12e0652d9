"""Hooks of mkdocs.

Files outside ``docs/`` that pages link to become part of the site. The lists of training keys and of command-line
options are written from the code, in place of the markers ``<!-- training keys -->`` and ``<!-- options -->``.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File

from r5dgs_core.cli import parser
from r5dgs_core.config import config, config_keys

ROOT = Path(__file__).resolve().parents[1]
_LINK = re.compile(r"\]\(<?([^)>\s]+)>?\)")


def _outside(target: str, page: str) -> str | None:
    """Path of a link's target relative to the repository, or None if it lies in ``docs/`` or elsewhere."""
    if re.match(r"[a-z]+:|#", target):
        return None
    path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), target.partition("#")[0]))
    return None if path.startswith("docs/") or not (ROOT / path).is_file() else path


def on_files(files, config):
    """Add the linked files, below ``files/``; Markdown becomes plain text."""
    for page in list(files.documentation_pages()):
        for target in _LINK.findall(page.content_string):
            path = _outside(target, page.src_uri)
            if path is not None and files.get_file_from_path(_place(path)) is None:
                files.append(File.generated(config, _place(path), abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Let links point to the added files."""

    def replace(match: re.Match[str]) -> str:
        path = _outside(match[1], page.file.src_uri)
        if path is None:
            return match[0]
        return f"]({posixpath.relpath(_place(path), posixpath.dirname(page.file.src_uri) or '.')})"

    markdown = _LINK.sub(replace, markdown)
    return markdown.replace("<!-- training keys -->", _keys()).replace("<!-- options -->", _options())


def _place(path: str) -> str:
    return f"files/{path}" + (".txt" if path.endswith((".md", ".py")) or "." not in path else "")


def _keys() -> str:
    """Tables of all training keys, one per section of the configuration."""
    lines, section = [], ""
    for key in config_keys.keys(config.Config()):
        if key.name.partition(".")[0] != section:
            section = key.name.partition(".")[0]
            lines += ["", f"### {section}", "", "| key | default | unit | meaning |", "|---|---|---|---|"]
        lines.append(f"| `{key.name}` | `{key.default}` | {key.unit} | {key.meaning.replace('|', '&#124;')} |")
    return "\n".join(lines)


def _options() -> str:
    """The help of every command."""
    commands = next(action for action in parser.parser()._actions if action.dest == "command").choices
    return "\n".join(f"### {name}\n\n```text\n{command.format_help()}```\n" for name, command in commands.items())
