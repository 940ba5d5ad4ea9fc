"""Round whole numbers, such as sides of images."""


def up_to_multiple(count: int, size: int) -> int:
    """Return the smallest multiple of `size` that is not below `count`."""
    return -(-count // size) * size
