"""`velfield analyse`: the analyses of a run as tables, JSON, GeoJSON, a report and a workbook."""
