# The tables of docs/highway.md and of the highway on docs/results.md and docs/trust.md, in hours:
#
#   make -j2 highway        on two cores; what is in runs/highway is not done again
#
# After a change of what is measured, remove runs/highway first. The numbers are printed by
# benchmarks.highway (*.txt), reach, highway_gap, highway_messages and sbc, which put their rows
# into docs/results; those of predictions go there by hand, as baselines are not run again.

HIGHWAY := runs/highway
FOG := --domain highway --setting fog --population diverse
ONE := OMP_NUM_THREADS=1 $(BIN)/python -m

FOUND := robot.txt cut_ins.txt reach.txt gap.txt messages.txt sbc.txt prediction.done

.PHONY: highway
highway: $(FOUND:%=$(HIGHWAY)/%) ## The highway's numbers; hours; rows in docs/results, more in runs/highway

$(HIGHWAY): $(STAMP)
	mkdir -p $@

$(HIGHWAY)/robot.txt: | $(HIGHWAY)
	$(ONE) benchmarks.highway > $@.new
	mv $@.new $@

$(HIGHWAY)/cut_ins.txt: | $(HIGHWAY)
	$(ONE) benchmarks.highway --rounds 900 --seed 11 --drivers robot --out $(@:txt=csv) > $@.new
	mv $@.new $@

$(HIGHWAY)/highway_0/posterior.nc: | $(HIGHWAY)
	$(ONE) mirror_ppl.fit $(FOG) --train-rounds 20 --explore 0 --jobs 1 --out $(@D)

$(HIGHWAY)/forty.nc $(HIGHWAY)/ten.nc: | $(HIGHWAY)
	$(ONE) mirror_ppl.simulate $(FOG) --seed 1 --rounds 20 --out $@ \
		--people $(if $(findstring ten,$@),10,40)

$(HIGHWAY)/highway_1/posterior.nc: $(HIGHWAY)/forty.nc
	$(ONE) mirror_ppl.fit --demos $< --train-rounds 19 --explore 0 --jobs 1 --out $(@D)

$(HIGHWAY)/ten/posterior.nc: $(HIGHWAY)/ten.nc
	$(ONE) mirror_ppl.fit --demos $< --train-rounds 20 --explore 0 --jobs 1 --out $(@D)

$(HIGHWAY)/reach.txt: $(HIGHWAY)/highway_0/posterior.nc $(HIGHWAY)/highway_1/posterior.nc
	$(ONE) benchmarks.reach $(^D) > $@.new
	mv $@.new $@

$(HIGHWAY)/gap.txt: $(HIGHWAY)/highway_0/posterior.nc $(HIGHWAY)/ten/posterior.nc
	$(ONE) benchmarks.highway_gap $<
	$(ONE) benchmarks.highway_gap $< --receive mirror --rounds 2
	$(ONE) benchmarks.highway_gap $(lastword $^) --receive mirror --rounds 4 --seed 1 > $@.new
	mv $@.new $@

$(HIGHWAY)/fog.done: | $(HIGHWAY)
	$(ONE) mirror_ppl.evaluate assistance $(FOG) --people 10 --seeds 1 --rounds 0 20 --played 8 \
		--models mirror bc sqil none all nearest oracle --jobs 1 --out $(@:.done=)
	touch $@

$(HIGHWAY)/clear.done: | $(HIGHWAY)
	$(ONE) mirror_ppl.evaluate assistance $(FOG:fog=clear) --people 10 --seeds 1 --rounds 20 \
		--played 8 --models mirror none all nearest oracle --jobs 1 --out $(@:.done=)
	touch $@

$(HIGHWAY)/messages.txt: $(HIGHWAY)/fog.done $(HIGHWAY)/clear.done
	$(ONE) benchmarks.highway_messages $(^:.done=/assistance.csv) > $@.new
	mv $@.new $@

$(HIGHWAY)/prediction.done: | $(HIGHWAY)
	$(ONE) mirror_ppl.evaluate prediction $(FOG) --people 10 --seeds 1 --rounds 1 5 20 \
		--models mirror mirror-pooled no-implants --jobs 1 --out $(@:.done=)
	touch $@

$(HIGHWAY)/sbc.txt: | $(HIGHWAY)
	$(ONE) mirror_ppl.calibrate --domain highway --people 100 --jobs 1 --out $(@D)/calibration
	$(ONE) benchmarks.sbc $(@D)/calibration/calibration.nc > $@.new
	mv $@.new $@
