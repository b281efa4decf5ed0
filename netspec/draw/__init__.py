"""Pictures of nets: what is drawn (diagram, blocks), where (layout, picture), and in which format (svg, html, png)."""
