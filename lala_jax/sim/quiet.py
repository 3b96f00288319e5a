"""Import MJX without the lines it prints to standard output where Warp is missing."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

__all__ = ["mjx"]
