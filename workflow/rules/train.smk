# The decomposition f = -D∇V + g by two networks; runs of one block train side by side.


rule train:
    input:
        recordings=of_every_run("recordings.parquet"),
        fields=of_every_run("vector_field.json"),
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
        settings=settings_of(TrainSettings),
    message:
        "{wildcards.study}, runs {wildcards.block}: training the networks"
    script:
        "../scripts/train.py"
