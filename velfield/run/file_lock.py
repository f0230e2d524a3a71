"""The system's lock on an open file, held until it is closed or the process ends: POSIX or Windows.

Windows locks bytes, and nobody else can read them: the one byte that is locked lies far behind the content.
"""

import errno
import sys
from typing import IO

_FAR_BYTE = 1 << 30


def try_lock(file: IO[str]) -> bool:
    """Lock an open file for this process; whether it was free.

    Raises
    ------
    OSError
        The file system has no locks.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            position = file.tell()
            file.seek(_FAR_BYTE)
            try:
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            finally:
                file.seek(position)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.EAGAIN, errno.EACCES, errno.EDEADLK):
            raise
        return False
    return True
