"""Where the gap between simulation and video lies, which effect causes it, how far it shrinks."""
