"""A zenoh router with a configuration file, as `zenohd --config FILE` is one."""

import sys
import threading

import zenoh

with zenoh.open(zenoh.Config.from_file(sys.argv[1])):
    threading.Event().wait()
