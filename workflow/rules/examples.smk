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
