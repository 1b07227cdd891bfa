"""What a dataflow.yaml says: read, checked with line and column, and drawn; nothing here runs anything."""
