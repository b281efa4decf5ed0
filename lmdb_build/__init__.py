"""The bridge: image sequences become labelled pairs, and pairs become databases for Data layers."""
