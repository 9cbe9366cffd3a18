# Recordings to try things with, made rather than shipped.


rule example_recordings:
    input:
        card=ancient(str(config_path("systems", "archetype3d.yaml"))),
    output:
        recordings="results/examples/archetype3d.parquet",
    log:
        "results/examples/logs/archetype3d.log",
    benchmark:
        "results/examples/benchmarks/archetype3d.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("example_recordings.py"),
        seed=0,
        run=0,
        simulation={"trajectories": 400, "pairs": 50},
    message:
        "simulating the example recordings"
    script:
        "../scripts/example_recordings.py"


rule example_hopping:
    output:
        recordings="results/examples/double-well.csv",
    log:
        "results/examples/logs/double-well.log",
    benchmark:
        "results/examples/benchmarks/double-well.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("example_hopping.py"),
    message:
        "simulating hopping recordings of a noisy camera"
    script:
        "../scripts/example_hopping.py"
