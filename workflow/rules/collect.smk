# All runs of a study as tables.


rule collect:
    input:
        coefficients=all_runs("results/{study}/runs/{run}/coefficients.parquet"),
        rrmse=all_runs("results/{study}/runs/{run}/rrmse.parquet"),
        prediction=all_runs("results/{study}/runs/{run}/prediction.parquet"),
        certificates=all_runs("results/{study}/runs/{run}/certificates.parquet"),
        record=all_runs("results/{study}/runs/{run}/record.parquet"),
        record_density=all_runs("results/{study}/runs/{run}/record_density.parquet"),
        landscape=of_landscapes("results/{study}/runs/{run}/landscape.parquet"),
        degrees=of_landscapes("results/{study}/runs/{run}/degrees.parquet"),
        training=all_blocks("results/{study}/training/{block}/history.parquet"),
        outcomes=all_outcomes,
        published=published_if_any,
    output:
        coefficients="results/{study}/tables/coefficients.parquet",
        rrmse="results/{study}/tables/rrmse.parquet",
        prediction="results/{study}/tables/prediction.parquet",
        certificates="results/{study}/tables/certificates.parquet",
        record="results/{study}/tables/record.parquet",
        record_density="results/{study}/tables/record_density.parquet",
        landscape="results/{study}/tables/landscape.parquet",
        degrees="results/{study}/tables/degrees.parquet",
        training="results/{study}/tables/training.parquet",
        outcomes="results/{study}/tables/outcomes.parquet",
        timings="results/{study}/tables/timings.parquet",
        summary="results/{study}/tables/summary.parquet",
        csv=report(
            "results/{study}/tables/summary.csv",
            caption="../report/summary.rst",
            category="{study}",
            subcategory=EVIDENCE,
            labels={"shows": "All quantities over the runs", "kind": "table"},
        ),
    log:
        "results/{study}/logs/collect.log",
    benchmark:
        "results/{study}/benchmarks/collect.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("collect.py"),
        benchmarks="results/{study}/benchmarks",
    message:
        "{wildcards.study}: collecting the tables of all runs"
    script:
        "../scripts/collect.py"
