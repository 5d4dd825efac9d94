"""Words for numbers and names, as messages and summaries print them."""


def number_of(n: int, noun: str, plural: str | None = None) -> str:
    """A number with its noun, such as "1 sample" and "3 samples".

    Args:
        n: The number.
        noun: The noun for one.
        plural: The noun for several, where an s at the end is not enough.
    """
    if n == 1:
        return f"1 {noun}"
    return f"{n} {plural or noun + 's'}"


def numbered_names(prefix: str, n: int) -> list[str]:
    """The names of n things that nobody named: "u1", "u2", ..."""
    return [f"{prefix}{i}" for i in range(1, n + 1)]
