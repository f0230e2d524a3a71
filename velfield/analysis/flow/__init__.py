"""Flow and speed on lanes: profiles, free flow, volume and density, headways, conflicts."""
