# Figures, and the page that people read.


rule figures:
    input:
        coefficients="results/{study}/tables/coefficients.parquet",
        rrmse="results/{study}/tables/rrmse.parquet",
        training="results/{study}/tables/training.parquet",
        prediction="results/{study}/tables/prediction.parquet",
        record="results/{study}/tables/record.parquet",
        record_density="results/{study}/tables/record_density.parquet",
        models=all_runs("results/{study}/runs/{run}/model.json"),
        recordings=all_runs("results/{study}/runs/{run}/recordings.parquet"),
        networks=networks_of_runs("networks.npz"),
        blocks=networks_of_runs("train.json"),
        fields=of_landscapes("results/{study}/runs/{run}/vector_field.json"),
        landscapes=of_landscapes("results/{study}/runs/{run}/quasipotential.json"),
        every_field=all_runs("results/{study}/runs/{run}/vector_field.json"),
        overview="results/{study}/overview.json",
        card=card_if_any,
        published=published_if_any,
    output:
        drawn=directory("results/{study}/drawn/study"),
    log:
        "results/{study}/logs/figures.log",
    benchmark:
        "results/{study}/benchmarks/figures.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("figures.py"),
        settings=settings_of(FiguresSettings),
        card=card_says,
        exact=exact_answer,
        folder=lambda wildcards, output: output.drawn,
    message:
        "{wildcards.study}: drawing the figures"
    script:
        "../scripts/figures.py"


rule page:
    input:
        summary="results/{study}/tables/summary.parquet",
        rrmse="results/{study}/tables/rrmse.parquet",
        certificates="results/{study}/tables/certificates.parquet",
        coefficients="results/{study}/tables/coefficients.parquet",
        outcomes="results/{study}/tables/outcomes.parquet",
        record="results/{study}/tables/record.parquet",
        timings="results/{study}/tables/timings.parquet",
        models=all_runs("results/{study}/runs/{run}/model.json"),
        invariant="results/{study}/tables/invariant.parquet",
        well_shares="results/{study}/tables/well_shares.parquet",
        overview="results/{study}/overview.json",
        fields=all_runs("results/{study}/runs/{run}/vector_field.json"),
        drawn="results/{study}/drawn/study",
        drawn_landscape=with_landscape("results/{study}/drawn/landscape"),
        drawn_density="results/{study}/drawn/invariant",
        landscape="results/{study}/tables/landscape.parquet",
        landscape_errors=landscape_table("landscape_errors"),
        escape=landscape_table("escape"),
        beside_equations=with_equations(
            "results/{study}/tables/beside_equations.parquet"
        ),
        card=card_if_any,
        published=published_if_any,
    output:
        html=report(
            "results/{study}/report.html",
            caption="../report/report.rst",
            category="{study}",
            subcategory=ANSWER,
            labels={"shows": "The page: everything in one file", "kind": "page"},
        ),
        figures=report(
            directory("results/{study}/figures"),
            patterns=["{name}.svg"],
            caption="../report/figure.rst",
            category="{study}",
            subcategory=figure_part,
            labels=figure_labels,
        ),
        answer="results/{study}/answer.json",
    log:
        "results/{study}/logs/page.log",
    benchmark:
        "results/{study}/benchmarks/page.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("page.py"),
        command=lambda wildcards: study_of(wildcards).command(),
        settings=settings_of(PageSettings),
        captions=CAPTIONS,
        card=card_says,
        exact=exact_answer,
    message:
        "{wildcards.study}: writing the page"
    script:
        "../scripts/page.py"
