"""The viewer: what a run folder holds for its page, and the two small servers, to view and to annotate."""
