"""The viewer: the data of a run's page, and the servers, to view, to annotate and to georeference."""
