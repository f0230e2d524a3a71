"""The viewer: the data of a run's page, and the two servers, to view and to annotate."""
