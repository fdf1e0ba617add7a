"""A wide stage cut into parts, each a file written whole or not at all, on this process or on a cluster.

What is finished stays: the same command run again, on any engine, does only what is missing, and the parts give what
one process would have given. The engines know nothing of the stages.
"""

from __future__ import annotations

from lunargr_cli.fanout.job import Job, open_job

__all__ = ["Job", "open_job"]
