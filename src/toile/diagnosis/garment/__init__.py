"""Which effect the model of a person in a garment lacks, from masks of both: fits, evidence, verdict."""
