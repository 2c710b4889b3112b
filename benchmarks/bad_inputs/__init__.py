"""Everything that can be wrong with what toile is given: cases, how they are run, and how they are judged."""
