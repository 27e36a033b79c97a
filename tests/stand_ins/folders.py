"""What is in a folder, to compare it with what was there before."""


def files_of(folder):
    """The bytes of every file below a folder, by path in it."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
