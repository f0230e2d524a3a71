"""The commands of `velfield bench`, one a module."""
