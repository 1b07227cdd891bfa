"""Our messages in the forms of other systems, one conversion each: used by exports, by live sinks and by imports."""
