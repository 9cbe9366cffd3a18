# The decomposition f = -D∇V + g by two networks; runs of one block train side by side.


rule train:
    input:
        recordings=recordings_of_block,
    output:
        networks="results/{study}/training/{block}/networks.npz",
        history="results/{study}/training/{block}/history.parquet",
        outcome="results/{study}/training/{block}/train.json",
    log:
        "results/{study}/logs/{block}/train.log",
    benchmark:
        "results/{study}/benchmarks/{block}/train.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("train.py"),
        study=parameters("seed", "recordings", "simulation", "training", "metric"),
        # Not an output: a killed job keeps it, and the same command goes on from it.
        checkpoint="results/{study}/training/{block}/checkpoint.npz",
    message:
        "{wildcards.study}, runs {wildcards.block}: training the networks"
    script:
        "../scripts/train.py"
