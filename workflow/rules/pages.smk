# Figures, and the pages that people read; recordings to try things with.


use rule run_task as figures with:
    input:
        **tables("coefficients", "rrmse", "training", "prediction"),
        **tables("record", "record_density"),
        model=all_runs("results/{study}/runs/{run}/model.json"),
        recordings=all_runs("results/{study}/runs/{run}/recordings.parquet"),
        networks=networks_of_runs("networks.npz"),
        train_outcome=networks_of_runs("train.json"),
        quasipotential=of_landscapes("results/{study}/runs/{run}/quasipotential.json"),
        field=all_runs("results/{study}/runs/{run}/vector_field.json"),
        overview="results/{study}/overview.json",
        card=card_if_any,
        published=published_if_any,
    output:
        drawn=directory("results/{study}/drawn/study"),
    log:
        "results/{study}/logs/figures.log",
    benchmark:
        "results/{study}/benchmarks/figures.tsv"
    params:
        **task("figures"),
    message:
        "{wildcards.study}: drawing the figures"


use rule run_task as page with:
    input:
        **tables("summary", "rrmse", "certificates", "coefficients"),
        **tables(
            "outcomes", "record", "timings", "landscape", "invariant", "well_shares"
        ),
        model=all_runs("results/{study}/runs/{run}/model.json"),
        overview="results/{study}/overview.json",
        field=all_runs("results/{study}/runs/{run}/vector_field.json"),
        drawn="results/{study}/drawn/study",
        drawn_landscape=file_where(
            lambda study: study.landscape is not None,
            "results/{study}/drawn/landscape",
        ),
        drawn_density="results/{study}/drawn/invariant",
        landscape_errors=landscape_table("landscape_errors"),
        escape=landscape_table("escape"),
        beside_equations=file_where(
            lambda study: study.beside_equations,
            "results/{study}/tables/beside_equations.parquet",
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
    params:
        **task("page"),
        captions=CAPTIONS,  # of Snakemake's own report
    message:
        "{wildcards.study}: writing the page"


use rule run_task as reproduction with:
    input:
        summaries=expand("results/{study}/tables/summary.parquet", study=REPRODUCED),
        reports=expand("results/{study}/report.html", study=REPRODUCED),
        published=of_reproduced("published"),
        card=of_reproduced("card"),
        contents=str(config_path("published", "contents.yaml")),
        parameters=str(config_path("published", "parameters.yaml")),
        contradictions=str(config_path("published", "contradictions.yaml")),
    output:
        html="results/reproduction.html",
        csv="results/reproduction.csv",
    log:
        "results/logs/reproduction.log",
    benchmark:
        "results/benchmarks/reproduction.tsv"
    params:
        **task("reproduction"),
        names=REPRODUCED,
        studies=reproduced_settings,
    message:
        "writing the page of the reproduction"


use rule run_task as example_recordings with:
    input:
        card=ancient(str(config_path("systems", "archetype3d.yaml"))),
    output:
        recordings="results/examples/archetype3d.parquet",
    log:
        "results/examples/logs/archetype3d.log",
    benchmark:
        "results/examples/benchmarks/archetype3d.tsv"
    params:
        **task("example_recordings"),
        seed=0,
        run=0,
        simulation={"trajectories": 400, "pairs": 50},
    message:
        "simulating the example recordings"


use rule run_task as example_hopping with:
    output:
        text="results/examples/double-well.csv",
    log:
        "results/examples/logs/double-well.log",
    benchmark:
        "results/examples/benchmarks/double-well.tsv"
    params:
        **task("example_hopping"),
    message:
        "simulating hopping recordings of a noisy camera"
