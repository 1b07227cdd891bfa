"""The live page: what the samples of a flow, or of a recording, become in a browser. See docs/how-to/view.md."""
