# The landscape of every run: equilibria, a formula for each well, barriers, paths; and what it is held against.


rule landscape:
    input:
        recordings="results/{study}/runs/{run}/recordings.parquet",
        field="results/{study}/runs/{run}/vector_field.json",
        model="results/{study}/runs/{run}/model.json",
    output:
        quasipotential="results/{study}/runs/{run}/quasipotential.json",
        table="results/{study}/runs/{run}/landscape.parquet",
        degrees="results/{study}/runs/{run}/degrees.parquet",
        outcome="results/{study}/runs/{run}/landscape.json",
    log:
        "results/{study}/logs/{run}/landscape.log",
    benchmark:
        "results/{study}/benchmarks/{run}/landscape.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("landscape.py"),
        settings=settings_of(LandscapeSettings),
    message:
        "{wildcards.study}, run {wildcards.run}: finding the landscape"
    script:
        "../scripts/landscape.py"


rule overview:
    # The landscape of the run that is shown; where the study asks for none, it is found for this run alone.
    input:
        rrmse="results/{study}/tables/rrmse.parquet",
        models=all_runs("results/{study}/runs/{run}/model.json"),
        fields=all_runs("results/{study}/runs/{run}/vector_field.json"),
        recordings=all_runs("results/{study}/runs/{run}/recordings.parquet"),
        landscapes=of_landscapes("results/{study}/runs/{run}/quasipotential.json"),
    output:
        overview="results/{study}/overview.json",
    log:
        "results/{study}/logs/overview.log",
    benchmark:
        "results/{study}/benchmarks/overview.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("overview.py"),
        settings=settings_of(LandscapeSettings),
        every_run=lambda wildcards: study_of(wildcards).study.landscape is not None,
    message:
        "{wildcards.study}: choosing the landscape that the page opens with"
    script:
        "../scripts/overview.py"


rule reference:
    # What methods say of the card's own vector field that share no code with ours.
    input:
        card=card_if_any,
    output:
        "results/{study}/reference.npz",
    log:
        "results/{study}/logs/reference.log",
    benchmark:
        "results/{study}/benchmarks/reference.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("reference.py"),
        settings=settings_of(ReferenceSettings),
        card=card_says,
    message:
        "{wildcards.study}: computing references for the landscape"
    script:
        "../scripts/reference.py"


rule landscape_errors:
    input:
        reference="results/{study}/reference.npz",
        fields=all_runs("results/{study}/runs/{run}/vector_field.json"),
        landscapes=all_runs("results/{study}/runs/{run}/quasipotential.json"),
        models=all_runs("results/{study}/runs/{run}/model.json"),
        networks=networks_of_runs("networks.npz"),
        training=networks_of_runs("train.json"),
        published=published_if_any,
        mesh=published_mesh_if_any,
    output:
        table="results/{study}/tables/landscape_errors.parquet",
        csv="results/{study}/tables/landscape_errors.csv",
    log:
        "results/{study}/logs/landscape_errors.log",
    benchmark:
        "results/{study}/benchmarks/landscape_errors.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("landscape_errors.py"),
        settings=settings_of(LandscapeErrorsSettings),
    message:
        "{wildcards.study}: holding the landscapes against the references"
    script:
        "../scripts/landscape_errors.py"


rule beside_equations:
    # The landscape of the card's own equations beside those of the runs: scoring alone.
    input:
        landscapes=all_runs("results/{study}/runs/{run}/quasipotential.json"),
        card=card_if_any,
    output:
        table="results/{study}/tables/beside_equations.parquet",
        csv="results/{study}/tables/beside_equations.csv",
    log:
        "results/{study}/logs/beside_equations.log",
    benchmark:
        "results/{study}/benchmarks/beside_equations.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("beside_equations.py"),
        settings=settings_of(BesideEquationsSettings),
        card=card_says,
    message:
        "{wildcards.study}: holding the landscapes against that of the equations"
    script:
        "../scripts/beside_equations.py"


rule escapes:
    input:
        landscapes=all_runs("results/{study}/runs/{run}/quasipotential.json"),
        card=card_if_any,
    output:
        table="results/{study}/tables/escape.parquet",
        csv="results/{study}/tables/escape.csv",
    log:
        "results/{study}/logs/escapes.log",
    benchmark:
        "results/{study}/benchmarks/escapes.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("escapes.py"),
        settings=settings_of(EscapesSettings),
        card=card_says,
    message:
        "{wildcards.study}: simulating escapes"
    script:
        "../scripts/escapes.py"


rule landscape_figures:
    input:
        reference=with_card("results/{study}/reference.npz"),
        escape=with_card("results/{study}/tables/escape.parquet"),
        degrees="results/{study}/tables/degrees.parquet",
        fields=all_runs("results/{study}/runs/{run}/vector_field.json"),
        landscapes=all_runs("results/{study}/runs/{run}/quasipotential.json"),
        models=all_runs("results/{study}/runs/{run}/model.json"),
        recordings=all_runs("results/{study}/runs/{run}/recordings.parquet"),
        networks=networks_of_runs("networks.npz"),
        training=networks_of_runs("train.json"),
        published=published_if_any,
        mesh=published_mesh_if_any,
    output:
        drawn=directory("results/{study}/drawn/landscape"),
    log:
        "results/{study}/logs/landscape_figures.log",
    benchmark:
        "results/{study}/benchmarks/landscape_figures.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("landscape_figures.py"),
        settings=settings_of(LandscapeFiguresSettings),
        folder=lambda wildcards, output: output.drawn,
    message:
        "{wildcards.study}: drawing the landscape"
    script:
        "../scripts/landscape_figures.py"
