# The science in its order: draw trajectories, identify f, train two networks, regress and refine formulas of V, score
# every run, collect all of them. A rule says which files its task reads and makes; the tasks are in workflow/steps.py.


rule run_task:
    # What every rule shares that has a task: nothing asks for this one.
    log:
        "results/logs/run_task.log",
    conda:
        "../envs/siq.yaml"
    script:
        "../scripts/run_task.py"


use rule run_task as draw with:
    # One rule for both entrances: whatever follows cannot tell them apart.
    input:
        unpack(data_source),
    output:
        recordings="results/{study}/runs/{run}/recordings.parquet",
        draw_outcome="results/{study}/runs/{run}/draw.json",
    log:
        "results/{study}/logs/{run}/draw.log",
    benchmark:
        "results/{study}/benchmarks/{run}/draw.tsv"
    params:
        **task("draw"),
    message:
        "{wildcards.study}, run {wildcards.run}: drawing trajectories"


use rule run_task as identify with:
    input:
        recordings="results/{study}/runs/{run}/recordings.parquet",
    output:
        field="results/{study}/runs/{run}/vector_field.json",
        identify_outcome="results/{study}/runs/{run}/identify.json",
    log:
        "results/{study}/logs/{run}/identify.log",
    benchmark:
        "results/{study}/benchmarks/{run}/identify.tsv"
    params:
        **task("identify"),
    message:
        "{wildcards.study}, run {wildcards.run}: rungs 4 and 5, the vector field and its noise"


use rule run_task as train with:
    input:
        recordings=of_every_run("recordings.parquet"),
        field=of_every_run("vector_field.json"),
    output:
        networks="results/{study}/training/{block}/networks.npz",
        history="results/{study}/training/{block}/history.parquet",
        train_outcome="results/{study}/training/{block}/train.json",
    log:
        "results/{study}/logs/{block}/train.log",
    benchmark:
        "results/{study}/benchmarks/{block}/train.tsv"
    params:
        **task("train"),
    message:
        "{wildcards.study}, runs {wildcards.block}: training the networks"


use rule run_task as regress with:
    input:
        unpack(training_of_run),
        recordings="results/{study}/runs/{run}/recordings.parquet",
    output:
        regression="results/{study}/runs/{run}/regression.json",
        regress_outcome="results/{study}/runs/{run}/regress.json",
    log:
        "results/{study}/logs/{run}/regress.log",
    benchmark:
        "results/{study}/benchmarks/{run}/regress.tsv"
    params:
        **task("regress"),
    message:
        "{wildcards.study}, run {wildcards.run}: regressing formulas"


use rule run_task as refine with:
    input:
        unpack(training_of_run),
        recordings="results/{study}/runs/{run}/recordings.parquet",
        field="results/{study}/runs/{run}/vector_field.json",
        identify_outcome="results/{study}/runs/{run}/identify.json",
        regression=regression_of_run,
    output:
        model="results/{study}/runs/{run}/model.json",
        refine_outcome="results/{study}/runs/{run}/refine.json",
        record="results/{study}/runs/{run}/record.parquet",
        record_density="results/{study}/runs/{run}/record_density.parquet",
    log:
        "results/{study}/logs/{run}/refine.log",
    benchmark:
        "results/{study}/benchmarks/{run}/refine.tsv"
    params:
        **task("refine"),
    message:
        "{wildcards.study}, run {wildcards.run}: rungs 1 to 3, states of the record, and 6, certified formulas"


use rule run_task as score with:
    input:
        unpack(training_of_run),
        model="results/{study}/runs/{run}/model.json",
        card=card_if_any,
    output:
        coefficients="results/{study}/runs/{run}/coefficients.parquet",
        rrmse="results/{study}/runs/{run}/rrmse.parquet",
        prediction="results/{study}/runs/{run}/prediction.parquet",
        certificates="results/{study}/runs/{run}/certificates.parquet",
        score_outcome="results/{study}/runs/{run}/score.json",
    log:
        "results/{study}/logs/{run}/score.log",
    benchmark:
        "results/{study}/benchmarks/{run}/score.tsv"
    params:
        **task("score"),
    message:
        "{wildcards.study}, run {wildcards.run}: scoring"


use rule run_task as collect with:
    input:
        **{
            name: all_runs(f"results/{{study}}/runs/{{run}}/{name}.parquet")
            for name in RUN_TABLES
        },
        landscape=of_landscapes("results/{study}/runs/{run}/landscape.parquet"),
        degrees=of_landscapes("results/{study}/runs/{run}/degrees.parquet"),
        training=all_blocks("results/{study}/training/{block}/history.parquet"),
        outcomes=all_outcomes,
        published=published_if_any,
    output:
        **tables(*RUN_TABLES, "landscape", "degrees", "training"),
        **tables("outcomes", "timings", "summary"),
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
    params:
        **task("collect"),
        benchmarks="results/{study}/benchmarks",
    message:
        "{wildcards.study}: collecting the tables of all runs"
