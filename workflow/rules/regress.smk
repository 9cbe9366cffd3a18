# Sparse formulas of V, g and f from the networks.


rule regress:
    input:
        recordings="results/{study}/runs/{run}/recordings.parquet",
        networks=of_block("networks.npz"),
        outcome=of_block("train.json"),
    output:
        model="results/{study}/runs/{run}/regression.json",
        outcome="results/{study}/runs/{run}/regress.json",
    log:
        "results/{study}/logs/{run}/regress.log",
    benchmark:
        "results/{study}/benchmarks/{run}/regress.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("regress.py"),
        settings=settings_of(RegressSettings),
    message:
        "{wildcards.study}, run {wildcards.run}: regressing formulas"
    script:
        "../scripts/regress.py"
