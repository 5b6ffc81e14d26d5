"""A preprocessor of mdBook: a link that leads out of docs/ has no page in the book, so it becomes its text and the file's path."""

import json
import re
import sys

LINK = re.compile(r"\[([^\]]+)\]\(\.\./([^)#\s]+)(?:#[^)]*)?\)")


def plain(link):
    text, path = link.groups()
    name = path.rsplit("/", 1)[-1]
    return f"`{path}`" if text.strip("`") == name else f"{text} (`{path}`)"


def turn(items):
    for item in items:
        chapter = item.get("Chapter") if isinstance(item, dict) else None
        if chapter:
            chapter["content"] = LINK.sub(plain, chapter["content"])
            turn(chapter["sub_items"])


if len(sys.argv) > 1 and sys.argv[1] == "supports":
    sys.exit(0)
_, book = json.load(sys.stdin)
turn(book.get("items", book.get("sections", [])))
json.dump(book, sys.stdout)
