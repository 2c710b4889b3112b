"""The pages of a report: one self-contained HTML file each, with its own style sheet and scripts."""
