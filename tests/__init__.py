"""Checks. Libraries start no threads of their own here, as in the command: two processes run them side by side."""

from flows.launch import limit_threads

limit_threads()
