# The landscape of every run: equilibria, a formula for each well, barriers, paths; and what it is held against.


use rule run_task as landscape with:
    input:
        recordings="results/{study}/runs/{run}/recordings.parquet",
        field="results/{study}/runs/{run}/vector_field.json",
        model="results/{study}/runs/{run}/model.json",
    output:
        quasipotential="results/{study}/runs/{run}/quasipotential.json",
        landscape="results/{study}/runs/{run}/landscape.parquet",
        degrees="results/{study}/runs/{run}/degrees.parquet",
        landscape_outcome="results/{study}/runs/{run}/landscape.json",
    log:
        "results/{study}/logs/{run}/landscape.log",
    benchmark:
        "results/{study}/benchmarks/{run}/landscape.tsv"
    params:
        **task("landscape"),
    message:
        "{wildcards.study}, run {wildcards.run}: finding the landscape"


use rule run_task as overview with:
    # The landscape of the run that is shown; where the study asks for none, it is found for this run alone.
    input:
        rrmse="results/{study}/tables/rrmse.parquet",
        model=all_runs("results/{study}/runs/{run}/model.json"),
        field=all_runs("results/{study}/runs/{run}/vector_field.json"),
        recordings=all_runs("results/{study}/runs/{run}/recordings.parquet"),
        quasipotential=of_landscapes("results/{study}/runs/{run}/quasipotential.json"),
    output:
        overview="results/{study}/overview.json",
    log:
        "results/{study}/logs/overview.log",
    benchmark:
        "results/{study}/benchmarks/overview.tsv"
    params:
        **task("overview"),
    message:
        "{wildcards.study}: choosing the landscape that the page opens with"


use rule run_task as reference with:
    # What methods say of the card's own vector field that share no code with ours.
    input:
        card=card_if_any,
    output:
        reference="results/{study}/reference.npz",
    log:
        "results/{study}/logs/reference.log",
    benchmark:
        "results/{study}/benchmarks/reference.tsv"
    params:
        **task("reference"),
    message:
        "{wildcards.study}: computing references for the landscape"


use rule run_task as landscape_errors with:
    input:
        reference="results/{study}/reference.npz",
        field=all_runs("results/{study}/runs/{run}/vector_field.json"),
        quasipotential=all_runs("results/{study}/runs/{run}/quasipotential.json"),
        model=all_runs("results/{study}/runs/{run}/model.json"),
        networks=networks_of_runs("networks.npz"),
        train_outcome=networks_of_runs("train.json"),
        published=published_if_any,
        mesh=published_mesh_if_any,
    output:
        table="results/{study}/tables/landscape_errors.parquet",
        csv="results/{study}/tables/landscape_errors.csv",
    log:
        "results/{study}/logs/landscape_errors.log",
    benchmark:
        "results/{study}/benchmarks/landscape_errors.tsv"
    params:
        **task("landscape_errors"),
    message:
        "{wildcards.study}: holding the landscapes against the references"


use rule run_task as beside_equations with:
    # The landscape of the card's own equations beside those of the runs: scoring alone.
    input:
        quasipotential=all_runs("results/{study}/runs/{run}/quasipotential.json"),
        card=card_if_any,
    output:
        table="results/{study}/tables/beside_equations.parquet",
        csv="results/{study}/tables/beside_equations.csv",
    log:
        "results/{study}/logs/beside_equations.log",
    benchmark:
        "results/{study}/benchmarks/beside_equations.tsv"
    params:
        **task("beside_equations"),
    message:
        "{wildcards.study}: holding the landscapes against that of the equations"


use rule run_task as escapes with:
    input:
        quasipotential=all_runs("results/{study}/runs/{run}/quasipotential.json"),
        card=card_if_any,
    output:
        table="results/{study}/tables/escape.parquet",
        csv="results/{study}/tables/escape.csv",
    log:
        "results/{study}/logs/escapes.log",
    benchmark:
        "results/{study}/benchmarks/escapes.tsv"
    params:
        **task("escapes"),
    message:
        "{wildcards.study}: simulating escapes"


use rule run_task as landscape_figures with:
    input:
        reference=with_card("results/{study}/reference.npz"),
        escape=with_card("results/{study}/tables/escape.parquet"),
        degrees="results/{study}/tables/degrees.parquet",
        field=all_runs("results/{study}/runs/{run}/vector_field.json"),
        quasipotential=all_runs("results/{study}/runs/{run}/quasipotential.json"),
        model=all_runs("results/{study}/runs/{run}/model.json"),
        recordings=all_runs("results/{study}/runs/{run}/recordings.parquet"),
        networks=networks_of_runs("networks.npz"),
        train_outcome=networks_of_runs("train.json"),
        published=published_if_any,
        mesh=published_mesh_if_any,
    output:
        drawn=directory("results/{study}/drawn/landscape"),
    log:
        "results/{study}/logs/landscape_figures.log",
    benchmark:
        "results/{study}/benchmarks/landscape_figures.tsv"
    params:
        **task("landscape_figures"),
    message:
        "{wildcards.study}: drawing the landscape"


use rule run_task as invariant with:
    input:
        rrmse="results/{study}/tables/rrmse.parquet",
        model=all_runs("results/{study}/runs/{run}/model.json"),
        field=of_landscapes("results/{study}/runs/{run}/vector_field.json"),
        quasipotential=of_landscapes("results/{study}/runs/{run}/quasipotential.json"),
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
    params:
        **task("invariant"),
    message:
        "{wildcards.study}: computing the invariant distribution"
