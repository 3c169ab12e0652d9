"""Amounts in messages: "1 object", "40,000 Gaussians bend"."""


def of(count: int, noun: str, verb: str = "") -> str:
    """A number of things in words for the user, and what they do.

    Args:
        count: How many.
        noun: What one is called; the plural ends in s.
        verb: What several do; what one does ends in s.
    """
    one = count == 1
    things = f"{count:,} {noun}{'' if one else 's'}"
    return f"{things} {verb}{'s' if one else ''}" if verb else things
