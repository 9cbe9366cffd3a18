# Where the data of a run come from: a simulation of the system, or recordings.


rule draw:
    # One rule for both entrances: whatever follows cannot tell them apart.
    input:
        source=data_source,
        files=files_in_folder,
    output:
        recordings="results/{study}/runs/{run}/recordings.parquet",
        outcome="results/{study}/runs/{run}/draw.json",
    log:
        "results/{study}/logs/{run}/draw.log",
    benchmark:
        "results/{study}/benchmarks/{run}/draw.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("draw.py"),
        settings=settings_of(DrawSettings),
        card=card_says,
    message:
        "{wildcards.study}, run {wildcards.run}: drawing trajectories"
    script:
        "../scripts/draw.py"
