"""Write the page that has everything of the paper, with ours beside it: files in, one function, files out."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path

import yaml
from pydantic import TypeAdapter

from siq.numerics.files import whole_file
from siq.systems.cards import load_system
from siq.workflow.published import load_published
from siq.workflow.reproduction import load_contents, load_parameters
from step import job
from workflow.reproduction import ReproductionSettings
from workflow.reproduction.page import Paper, Results, render_reproduction, reproduction_page

if __name__ == "__main__":
    with job() as now:
        source = now.input
        settings = TypeAdapter(dict[str, ReproductionSettings]).validate_python(now.params.settings)
        studies = {
            name: Results(
                name,
                Path(summary).parents[1],
                settings[name],
                load_published(published).figures,
                load_system(card),
            )
            for name, summary, published, card in zip(
                now.params.names, source.summaries, source.published, source.cards, strict=True
            )
        }
        paper = Paper(
            load_contents(source.contents).places,
            load_parameters(source.parameters),
            yaml.safe_load(Path(source.contradictions).read_text(encoding="utf-8")),
        )
        content, table = reproduction_page(paper, studies, settings, command="snakemake --cores 2 reproduce")
        with whole_file(now.output.csv) as partial:
            table.to_csv(partial, index=False)
        with whole_file(now.output.html) as partial:
            partial.write_text(render_reproduction(content), encoding="utf-8")
