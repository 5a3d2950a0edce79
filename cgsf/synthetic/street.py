from cgsf.synthetic.things import things as street  # noqa
