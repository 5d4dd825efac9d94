"""What the page allows: sizes, numbers of sessions, times."""

# Bytes of one uploaded file. A table of a million numbers takes about 10 MB.
MOST_UPLOADED = 20_000_000
# What the name of an uploaded table may end in; the ending tells how it is read.
TABLE_KINDS = (".csv", ".txt", ".tsv", ".dat", ".xlsx")
# Bytes of the name of a file, in UTF-8: what file systems take.
MOST_NAME_BYTES = 255
# Bytes of a request beside the file: names, boundaries.
UPLOAD_OVERHEAD = 100_000
# Files of one study; each is a run.
MOST_FILES = 50
# Browsers that one server keeps; each may hold a process of about 300 MB.
MOST_SESSIONS = 20
# Seconds without work after which a worker ends; the session keeps its study.
IDLE_WORKER = 600.0
# Seconds without a sign of the browser after which a session is forgotten.
FORGOTTEN_SESSION = 24 * 3600.0
# Seconds that a cancelled worker has before it is killed.
CANCEL_GRACE = 1.0
# Lines of progress that are kept.
MOST_LINES = 200
# Points of one curve that are sent to the browser; a screen shows fewer.
CHART_POINTS = 4000


def in_megabytes(size: int) -> str:
    """A number of bytes in words: '20 MB'."""
    return f"{size / 1e6:.3g} MB"
