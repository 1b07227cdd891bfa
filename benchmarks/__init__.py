"""One hop, source -> relay -> sink, built with caneflow and with what people use instead; the same work in each."""
