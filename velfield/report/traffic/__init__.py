"""The report of a traffic analysis: diagrams, the first page, HTML and PDF."""
