# The vector field from the pairs alone, before any network.


rule identify:
    input:
        recordings="results/{study}/runs/{run}/recordings.parquet",
    output:
        field="results/{study}/runs/{run}/vector_field.json",
        outcome="results/{study}/runs/{run}/identify.json",
    log:
        "results/{study}/logs/{run}/identify.log",
    benchmark:
        "results/{study}/benchmarks/{run}/identify.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("identify.py"),
        settings=settings_of(IdentifySettings),
    message:
        "{wildcards.study}, run {wildcards.run}: identifying the vector field"
    script:
        "../scripts/identify.py"
