# V and g refined on the Hamilton–Jacobi equation, and the certificate of every formula.


rule refine:
    input:
        recordings="results/{study}/runs/{run}/recordings.parquet",
        field="results/{study}/runs/{run}/vector_field.json",
        identified="results/{study}/runs/{run}/identify.json",
        networks=of_block("networks.npz"),
        outcome=of_block("train.json"),
        model=regression_of_run,
    output:
        model="results/{study}/runs/{run}/model.json",
        outcome="results/{study}/runs/{run}/refine.json",
        record="results/{study}/runs/{run}/record.parquet",
        record_density="results/{study}/runs/{run}/record_density.parquet",
    log:
        "results/{study}/logs/{run}/refine.log",
    benchmark:
        "results/{study}/benchmarks/{run}/refine.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("refine.py"),
        settings=settings_of(RefineSettings),
    message:
        "{wildcards.study}, run {wildcards.run}: refining and certifying the formulas"
    script:
        "../scripts/refine.py"
