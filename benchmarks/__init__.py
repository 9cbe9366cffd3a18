"""What measures siq: the proof of the diagnosis, the paper's figures beside ours, and single benchmarks."""
