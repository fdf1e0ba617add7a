"""Imported by a test: gets an interruption while it is imported, and says so as numpy's C API does."""

import os
import signal
import time
import traceback

try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.1)
except BaseException:
    traceback.print_exc()
    raise
