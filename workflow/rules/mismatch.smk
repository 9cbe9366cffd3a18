# What physics a simulation lacks: the studies of config/mismatch/, and folders of cases (--config cases=DIR).


localrules:
    mismatch,
    diagnose,
    official,


rule official:
    input:
        "results/official/page.md",


rule mismatch:
    input:
        mismatch_pages,


rule diagnose:
    input:
        of_folder("results/mismatch/{case}/report.html"),


use rule run_task as benchmark_recordings with:
    input:
        file=raw_file,
    output:
        recordings="results/recordings/{benchmark}.parquet",
    log:
        "results/recordings/logs/{benchmark}.log",
    benchmark:
        "results/recordings/benchmarks/{benchmark}.tsv"
    params:
        **task("benchmark_recordings"),
    message:
        "{wildcards.benchmark}: reading the recordings of the benchmark"


use rule run_task as diagnosis with:
    input:
        card=case_file("card"),
        recordings=case_file("recordings"),
        study=case_file("study"),
    output:
        expand(
            "results/mismatch/{{case}}/tables/{table}.csv",
            table=MISMATCH_TABLES,
        ),
        **tables(*MISMATCH_TABLES, of=MISMATCH),
        verdict="results/mismatch/{case}/verdict.json",
        system="results/mismatch/{case}/system.yaml",
        recalibrated="results/mismatch/{case}/recalibrated.yaml",
    log:
        "results/mismatch/{case}/logs/diagnosis.log",
    benchmark:
        "results/mismatch/{case}/benchmarks/diagnosis.tsv"
    params:
        **task("diagnosis"),
        content=lambda wildcards: case_of(wildcards).content,
    message:
        "{wildcards.case}: looking for what the simulation lacks"


use rule run_task as mismatch_landscape with:
    input:
        verdict="results/mismatch/{case}/verdict.json",
        card=case_file("card"),
        recalibrated="results/mismatch/{case}/recalibrated.yaml",
        system="results/mismatch/{case}/system.yaml",
        forces="results/mismatch/{case}/tables/forces.parquet",
    output:
        expand(
            "results/mismatch/{{case}}/tables/{table}.csv",
            table=["wells", "escape"],
        ),
        **tables("wells", "escape", of=MISMATCH),
        notes="results/mismatch/{case}/landscape.json",
    log:
        "results/mismatch/{case}/logs/landscape.log",
    benchmark:
        "results/mismatch/{case}/benchmarks/landscape.tsv"
    params:
        **task("mismatch_landscape"),
    message:
        "{wildcards.case}: working out what that does to wells and escape times"


use rule run_task as official_tests with:
    input:
        card=case_file("card"),
        recordings=case_file("recordings"),
        study=case_file("study"),
        recalibrated="results/mismatch/{case}/recalibrated.yaml",
        system="results/mismatch/{case}/system.yaml",
        noise="results/mismatch/{case}/tables/noise.parquet",
    output:
        table="results/mismatch/{case}/tables/official_tests.parquet",
        csv="results/mismatch/{case}/tables/official_tests.csv",
        runs="results/mismatch/{case}/tables/official_runs.parquet",
        runs_csv="results/mismatch/{case}/tables/official_runs.csv",
    log:
        "results/mismatch/{case}/logs/official_tests.log",
    benchmark:
        "results/mismatch/{case}/benchmarks/official_tests.tsv"
    params:
        **task("official_tests"),
        benchmark=lambda wildcards: case_of(wildcards).benchmark,
    message:
        "{wildcards.case}: scoring the simulations in the official tests"


use rule run_task as official_summary with:
    input:
        tables=expand(
            "results/mismatch/{case}/tables/official_tests.parquet", case=BENCHMARKS
        ),
        runs=expand(
            "results/mismatch/{case}/tables/official_runs.parquet", case=BENCHMARKS
        ),
        verdict=expand("results/mismatch/{case}/verdict.json", case=BENCHMARKS),
        system=expand("results/mismatch/{case}/system.yaml", case=BENCHMARKS),
    output:
        table="results/official/table.parquet",
        csv="results/official/table.csv",
        page="results/official/page.md",
        figures=directory("results/official/figures"),
    log:
        "results/official/logs/official_summary.log",
    benchmark:
        "results/official/benchmarks/official_summary.tsv"
    params:
        **task("official_summary"),
        benchmarks=list(BENCHMARKS),
    message:
        "putting the official tests of all benchmarks into one table"


use rule run_task as mismatch_figures with:
    input:
        **tables(*MISMATCH_TABLES, "escape", of=MISMATCH),
        verdict="results/mismatch/{case}/verdict.json",
        card=case_file("card"),
        system="results/mismatch/{case}/system.yaml",
    output:
        # Which figures there are depends on what was found.
        folder=directory("results/mismatch/{case}/figures"),
    log:
        "results/mismatch/{case}/logs/mismatch_figures.log",
    benchmark:
        "results/mismatch/{case}/benchmarks/mismatch_figures.tsv"
    params:
        **task("mismatch_figures"),
    message:
        "{wildcards.case}: drawing what is missing"


use rule run_task as mismatch_page with:
    input:
        **tables("candidates", "wells", "escape", "held_out", of=MISMATCH),
        verdict="results/mismatch/{case}/verdict.json",
        card=case_file("card"),
        study=case_file("study"),
        system="results/mismatch/{case}/system.yaml",
        notes="results/mismatch/{case}/landscape.json",
        scores=scores_if_any,
        figures="results/mismatch/{case}/figures",
    output:
        html=report(
            "results/mismatch/{case}/report.html",
            caption="../report/mismatch.rst",
            category="What a simulation lacks",
            labels={"shows": "{case}", "kind": "page"},
        ),
        answer="results/mismatch/{case}/answer.json",
    log:
        "results/mismatch/{case}/logs/mismatch_page.log",
    benchmark:
        "results/mismatch/{case}/benchmarks/mismatch_page.tsv"
    params:
        **task("mismatch_page"),
        title=lambda wildcards: case_of(wildcards).title,
        command=lambda wildcards: case_of(wildcards).command,
    message:
        "{wildcards.case}: writing the report"
