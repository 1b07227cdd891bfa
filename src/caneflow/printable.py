"""Text of strangers, safe for a terminal: what a recording, a peer or a file name says may hold anything."""


def printable(text: str) -> str:
    r"""`text` with everything that is not a visible character or a space as an escape, e.g. `\x1b`.

    Control characters, line ends, marks that turn the direction of writing and lone surrogates are escaped; letters
    of every script stay.
    """
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)
