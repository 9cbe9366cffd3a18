# The invariant distribution of the formula that is shown, or of the landscape where no single formula holds.


rule invariant:
    input:
        rrmse="results/{study}/tables/rrmse.parquet",
        models=all_runs("results/{study}/runs/{run}/model.json"),
        fields=of_landscapes("results/{study}/runs/{run}/vector_field.json"),
        landscapes=of_landscapes("results/{study}/runs/{run}/quasipotential.json"),
        card=card_if_any,
        published=published_if_any,
    output:
        table="results/{study}/tables/invariant.parquet",
        csv="results/{study}/tables/invariant.csv",
        shares="results/{study}/tables/well_shares.parquet",
        shares_csv="results/{study}/tables/well_shares.csv",
        drawn=directory("results/{study}/drawn/invariant"),
    log:
        "results/{study}/logs/invariant.log",
    benchmark:
        "results/{study}/benchmarks/invariant.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("invariant.py"),
        settings=settings_of(InvariantSettings),
        card=card_says,
    message:
        "{wildcards.study}: computing the invariant distribution"
    script:
        "../scripts/invariant.py"
