# A control parameter: a job for each value, in a file of its name, so that another range makes new values only.


rule sweep_point:
    input:
        card=card_if_any,
    output:
        point="results/{study}/sweep/{point}.json",
    log:
        "results/{study}/logs/sweep/{point}.log",
    benchmark:
        "results/{study}/benchmarks/sweep/{point}.tsv"
    wildcard_constraints:
        study=STUDIES.pattern_of("equations"),
        point=r"\w+=[-+.e\d]+(,\w+=[-+.e\d]+)?",
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("sweep_point.py"),
        settings=settings_of(PointSettings),
        card=card_beside_sweep,
    message:
        "{wildcards.study}: the landscape at {wildcards.point}"
    script:
        "../scripts/sweep_point.py"


rule sweep:
    input:
        card=card_if_any,
        points=points_of_sweep,
    output:
        sweep="results/{study}/tables/sweep.parquet",
        sweep_ways="results/{study}/tables/sweep_ways.parquet",
        branches="results/{study}/tables/branches.parquet",
        bifurcations="results/{study}/tables/bifurcations.parquet",
        bifurcation_curves="results/{study}/tables/bifurcation_curves.parquet",
    log:
        "results/{study}/logs/sweep.log",
    benchmark:
        "results/{study}/benchmarks/sweep.tsv"
    wildcard_constraints:
        study=STUDIES.pattern_of("equations"),
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("sweep.py"),
        settings=settings_of(SweepSettings),
        card=card_beside_sweep,
    message:
        "{wildcards.study}: branches, barriers and times against the parameter"
    script:
        "../scripts/sweep.py"
